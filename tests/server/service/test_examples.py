"""Runs the docstring examples of the SDK against a worker.

Each runs separately: first the example of the class, which creates what its methods' examples use,
then the method's own. ``folder`` is an empty folder. The worker has the scene ``street``.
"""

from __future__ import annotations

import ast
import asyncio
import builtins
import contextlib
import doctest
import inspect
import io
import itertools
import shutil
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import real2sim
import real2sim.env
import real2sim.planners
import real2sim_proto
from real2sim._async import jobs as async_jobs
from real2sim._async import scenarios as async_scenarios
from real2sim._async import scenes as async_scenes
from real2sim._async import sessions as async_sessions
from real2sim._sync import jobs, scenarios, scenes, sessions
from real2sim_server.scene.io import save_scene, write_splats
from real2sim_server.service.serve import RunningWorker, running_worker
from real2sim_server.settings import Settings

from ..conftest import make_tiny_scene

pytestmark = pytest.mark.network

SDK_CLASSES: tuple[type, ...] = (
    real2sim.Client,
    scenes.Scenes,
    scenarios.Scenarios,
    scenarios.Scenario,
    scenarios.SceneObject,
    scenes.Assets,
    jobs.Jobs,
    jobs.Job,
    sessions.Sessions,
    jobs.Sweeps,
    real2sim.DriveSession,
    real2sim.AsyncClient,
    async_scenes.AsyncScenes,
    async_scenarios.AsyncScenarios,
    async_scenarios.AsyncScenario,
    async_scenarios.AsyncSceneObject,
    async_scenes.AsyncAssets,
    async_jobs.AsyncJobs,
    async_jobs.AsyncJob,
    async_sessions.AsyncSessions,
    async_jobs.AsyncSweeps,
    real2sim.AsyncDriveSession,
    real2sim.Image,
    real2sim.Frame,
    real2sim.View,
    real2sim.Observation,
    real2sim.env.DriveEnv,
)
TWINS = {
    sync: source
    for sync in SDK_CLASSES
    for source in SDK_CLASSES
    if source.__name__ == f"Async{sync.__name__}"
}
TOKEN = "opens-every-session"
PLANNERS = ("DepthSampling", "FollowRoute", "Idm", "LearnedPolicy", "PidFollowRoute")
FUNCTIONS: tuple[Any, ...] = (
    real2sim.connect,
    real2sim.connect_async,
    real2sim.make_env,
    real2sim.planners.load_planner,
    real2sim.planners.needs_of,
    real2sim.planners.run_episode,
    real2sim.planners.Needs.sensors,
    real2sim.planners.StageTimes.of,
    real2sim_proto.encode,
    real2sim_proto.decode,
    real2sim_proto.protocol_mismatch,
)


@dataclass(frozen=True)
class Documented:
    """A public item, and the class whose example runs before its own."""

    name: str
    value: Any
    owner: type | None = None

    @property
    def text(self) -> str:
        return inspect.cleandoc(self.value.__doc__ or "")


def documented() -> Iterator[Documented]:
    for function in FUNCTIONS:
        yield Documented(f"{function.__module__}.{function.__qualname__}", function)
    for name in PLANNERS:
        yield Documented(f"planners.{name}", getattr(real2sim.planners, name))
    yield Documented("Real2SimError", real2sim.Real2SimError)
    for owner in SDK_CLASSES:
        yield Documented(owner.__name__, owner)
        # Document the methods of a generated sync class at the asynchronous one.
        source = {name for name, _ in methods_of(TWINS[owner])} if owner in TWINS else set()
        for name, value in methods_of(owner):
            if name not in source:
                yield Documented(f"{owner.__name__}.{name}", value, owner)


def methods_of(owner: type) -> Iterator[tuple[str, Any]]:
    """Public methods of a class, including those inherited from bases outside SDK_CLASSES."""
    for base in owner.__mro__:
        if base is owner or (base.__module__.startswith("real2sim") and base not in SDK_CLASSES):
            yield from ((n, v) for n, v in vars(base).items() if is_public_method(n, v, owner))


def is_public_method(name: str, value: Any, owner: type) -> bool:
    if name.startswith("_") or not inspect.isfunction(value):
        return False
    # Methods shared by both variants are shown in sync form.
    shared = value.__module__ == "real2sim._object_edits"
    return not (shared and owner.__name__.startswith("Async"))


DOCUMENTED = {item.name: item for item in documented()}


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningWorker]:
    folder = tmp_path_factory.mktemp("worker")
    save_scene(make_tiny_scene("street"), folder / "scenes" / "street.r2s")
    (folder / "import").mkdir()
    write_splats(make_tiny_scene().background, folder / "import" / "corner.ply")
    settings = Settings(
        data_dir=folder / "data",
        scenes_dir=folder / "scenes",
        import_root=folder / "import",
        port=0,
        token=TOKEN,
        backend="cpu",
        log_level="error",
    )
    # A machine without cached kernels takes a while to become ready.
    with running_worker(settings, timeout_s=280.0) as running:
        yield running


@pytest.fixture
def names(
    worker: RunningWorker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[dict[str, Any]]:
    """Names available to examples. Removes what they leave on the worker."""
    monkeypatch.setenv("REAL2SIM_URL", worker.url)
    monkeypatch.setenv("REAL2SIM_TOKEN", TOKEN)
    write_splats(make_tiny_scene().background, tmp_path / "corner.ply")
    yield {"real2sim": real2sim, "np": np, "folder": tmp_path}
    with real2sim.connect() as client:
        for session in client.sessions.list():
            client.sessions.delete(session.session_id)
        for scenario in client.scenarios.list():
            client.scenarios.delete(scenario)
        for asset in client.assets.list():
            client.assets.delete(asset.asset_id)
    for bundle in worker.worker.settings.scenes_dir.iterdir():
        if bundle.name != "street.r2s":
            shutil.rmtree(bundle)


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.slow] if name == "AsyncSweeps.start" else [])
    for name in sorted(DOCUMENTED)
])  # fmt: skip
def test_every_public_item_has_an_example_that_runs(name: str, names: dict[str, Any]) -> None:
    item = DOCUMENTED[name]
    assert "Examples:" in item.text, f"{name} has no example"
    module = item.value if item.owner is None else item.owner
    names |= {k: v for k, v in vars(sys.modules[module.__module__]).items() if k[0] != "_"}
    texts = [item.text] if item.owner is None else [inspect.getdoc(item.owner) or "", item.text]
    asyncio.run(run_examples(texts, names))


def test_a_wrong_example_fails() -> None:
    with pytest.raises(AssertionError, match="gives 4 and not 5"):
        asyncio.run(run_examples([">>> 2 + 2\n5"], {}))


def test_an_example_that_raises_fails() -> None:
    with pytest.raises(KeyError):
        asyncio.run(run_examples([">>> {}['car']"], {}))


async def run_examples(texts: list[str], names: dict[str, Any]) -> None:
    """Run the examples of the texts in one namespace, then close open handles."""
    parser = doctest.DocTestParser()
    try:
        for example in itertools.chain.from_iterable(map(parser.get_examples, texts)):
            await run_example(example, names)
    finally:
        for value in [v for k, v in names.items() if k in {"session", "env", "client"}]:
            if inspect.isawaitable(closing := value.close()):
                await closing


async def run_example(example: doctest.Example, names: dict[str, Any]) -> None:
    """Run one example, which may use await, and compare its output."""
    printed = io.StringIO()
    flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
    names["__builtins__"] = vars(builtins)
    code = compile(example.source, "<example>", "single", flags, dont_inherit=True)
    with contextlib.redirect_stdout(printed):
        try:
            if inspect.iscoroutine(result := eval(code, names)):
                await result
        except Exception as error:
            if example.exc_msg is None:
                raise
            print("".join(traceback.format_exception_only(error)), end="")
    wanted = example.exc_msg if example.exc_msg is not None else example.want
    checker = doctest.OutputChecker()
    given = printed.getvalue().partition("\nhint: ")[0]
    assert checker.check_output(wanted, given, doctest.ELLIPSIS), (
        f"{example.source.strip()} gives {given.strip()} and not {wanted.strip()}"
    )
