"""Clips have the same bytes whichever executor makes them, even after a worker has died."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from real2sim_server.datasets.clips import ClipMakers
from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.plan import ExportPlan, Variant
from real2sim_server.edit import ScenarioState
from real2sim_server.executors import executor_of
from real2sim_server.scene.io import load_scene, save_scene

from .test_export import contents

PLAN = ExportPlan(
    formats=("labels", "coco"),
    cameras=("front",),
    width=48,
    period_us=250_000,
    end_us=1_500_000,
    clip_s=0.5,
)
DIES_AT = 750_000


class DyingDrive(ScenarioDrive):
    """The first process to read a certain instant dies."""

    mark: Path

    def at(self, t_us: int):
        if t_us == DIES_AT and not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().at(t_us)


def variants(path: Path, mark: Path | None = None) -> list[Variant]:
    scene = load_scene(path)
    state = ScenarioState.of(scene)
    if mark is None:
        return [Variant(ScenarioDrive(scene, state))]
    drive = DyingDrive(scene, state)
    object.__setattr__(drive, "mark", mark)
    return [Variant(drive)]


@pytest.fixture(scope="module")
def scene_file(tiny_scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "tiny.r2s"
    save_scene(tiny_scene, path)
    return path


@pytest.fixture(scope="module")
def alone(scene_file, tmp_path_factory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("alone") / "out"
    return contents(export_dataset(variants(scene_file), PLAN, out, backend="cpu"))


def made_by(name: str, scene_file: Path, out: Path, *, mark: Path | None = None, workers=2):
    recipe = partial(variants, scene_file, mark)
    makers = ClipMakers(executor_of(name, workers=workers), recipe, "cpu")
    frames = []
    export_dataset(
        variants(scene_file),
        PLAN,
        out,
        makers=makers,
        on_progress=lambda stage, done, total: frames.append((stage, done, total)),
    )
    assert ("frames", 7, 7) in frames
    return contents(out)


@pytest.mark.slow
def test_two_processes_give_the_same_bytes_as_one(scene_file, alone, tmp_path):
    assert made_by("processes", scene_file, tmp_path / "out") == alone


@pytest.mark.slow
def test_clips_of_a_dead_process_are_made_again(scene_file, alone, tmp_path):
    mark = tmp_path / "died"
    assert made_by("processes", scene_file, tmp_path / "out", mark=mark) == alone
    assert mark.exists()


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.parametrize("dies", [False, True])
def test_ray_gives_the_same_bytes_as_one_process_even_if_a_worker_dies(
    scene_file, alone, tmp_path, dies
):
    pytest.importorskip("ray")
    mark = tmp_path / "died" if dies else None
    assert made_by("ray", scene_file, tmp_path / "out", mark=mark) == alone
    assert mark is None or mark.exists()
