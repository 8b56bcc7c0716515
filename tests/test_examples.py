"""The scripts of ``examples``, run unchanged in an empty folder."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from real2sim_server.demo.street import unpack_street
from real2sim_server.service.serve import running_worker
from real2sim_server.settings import Settings
from tests.pages import LIMIT_S, PACKAGES, REPOSITORY

pytestmark = [pytest.mark.slow, pytest.mark.network]

EXAMPLES = {
    "own_log": ("objects: ['car_0']", "my_scene/scene.json"),
    "cut_in": ("Idm: ", None),
    "crash": ("car_6 hits ", "crash.webm"),
    "own_case": ("My cut-in: ", "own_case.xosc"),
    "own_planner": ("route_progress", None),
    "dataset": ("boxes", "dataset"),
    "train_policy": ("round 5: ", None),
}
"""Output of each example, and a file or folder that it creates."""


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A worker with the demo street."""
    root = tmp_path_factory.mktemp("worker")
    unpack_street(root / "scenes", "demo_street")
    settings = Settings(data_dir=root, port=0, backend="cpu", log_level="error")
    with running_worker(settings) as worker:
        yield worker.url


def test_every_example_is_tested() -> None:
    assert {path.stem for path in (REPOSITORY / "examples").glob("*.py")} == EXAMPLES.keys()


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name: str, url: str, tmp_path: Path) -> None:
    said, left = EXAMPLES[name]
    path = os.pathsep.join(str(REPOSITORY / package) for package in PACKAGES)
    done = subprocess.run(
        [sys.executable, REPOSITORY / "examples" / f"{name}.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path, "REAL2SIM_URL": url},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert said in done.stdout
    assert left is None or (tmp_path / left).exists()
