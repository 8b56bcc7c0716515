"""A worker with the tiny scene, for policy evaluation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from real2sim_server.policies.episodes import EpisodeResult, WorkerTarget, run_episodes
from real2sim_server.policies.suite import Case, EpisodeGrid
from real2sim_server.scene import Scene
from real2sim_server.scene.io import save_scene
from real2sim_server.service.serve import RunningWorker, running_worker
from real2sim_server.settings import Settings

BRAKES = {"kind": "hard_brake", "delay": 0.2, "gap": 30.0, "braking": 9.0}
CASES = [
    Case(name="free", scene="tiny", operations=[{"op": "delete", "object_id": "car_blue"}]),
    Case(
        name="brakes",
        scene="tiny",
        reset={"agents": {"drivers": {"car_blue": BRAKES}}},
        jitter={"agents.drivers.car_blue.gap": 5.0},
    ),
]
BROKEN = (
    "class Dies:\n    def reset(self, obs): pass\n    def plan(self, obs): raise KeyError('map')\n"
)


@pytest.fixture(scope="session")
def site(
    tmp_path_factory: pytest.TempPathFactory, tiny_scene: Scene, worker_kernels: None
) -> Iterator[RunningWorker]:
    folder = tmp_path_factory.mktemp("policies")
    save_scene(tiny_scene, folder / "scenes" / "tiny.r2s")
    settings = Settings(
        data_dir=folder / "data",
        scenes_dir=folder / "scenes",
        port=0,
        backend="cpu",
        log_level="error",
    )
    with running_worker(settings) as running:
        yield running


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("evaluated")


@pytest.fixture(scope="session")
def results(site: RunningWorker, folder: Path) -> list[EpisodeResult]:
    """Both cases with two seeds, for a blind planner, one that sees, and one that raises."""
    with pytest.MonkeyPatch.context() as patch:
        (folder / "broken.py").write_text(BROKEN)
        patch.chdir(folder)
        grid = EpisodeGrid(CASES, ("pid", "idm", "broken:Dies"), (0, 1))
        return run_episodes(grid, WorkerTarget(site.url, site.token), folder / "recordings")
