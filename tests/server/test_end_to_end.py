"""The SDK against a real worker: what a user's first program does."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import real2sim
from real2sim.planners import FollowRoute, run_episode
from real2sim_server.logs import write_native_log
from real2sim_server.reconstruct import ReconstructOptions, reconstruct
from real2sim_server.reconstruct.training.schedule import preset
from real2sim_server.scene import Scene
from real2sim_server.scene.io import load_scene, save_scene
from real2sim_server.service.serve import RunningWorker, running_worker
from real2sim_server.settings import Settings
from real2sim_server.synthetic import SyntheticConfig, generate_log

pytestmark = pytest.mark.network


@pytest.fixture(scope="module")
def worker(
    tmp_path_factory: pytest.TempPathFactory, tiny_scene: Scene, worker_kernels: None
) -> Iterator[RunningWorker]:
    folder = tmp_path_factory.mktemp("worker")
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


@pytest.fixture
def sim(worker: RunningWorker) -> Iterator[real2sim.Client]:
    with real2sim.connect(worker.url, token=worker.token) as client:
        yield client


def test_a_planner_drives_the_street_with_camera_frames(sim):
    with sim.session(scene="tiny") as session:
        seen = []
        summary = run_episode(
            session,
            FollowRoute(speed=5.0),
            steps=8,
            sensors=["front", "left"],
            privileged=True,
            on_observation=seen.append,
        )
    assert summary.steps == 8
    assert summary.distance == pytest.approx(8 * 0.5, abs=0.6)
    assert [obs.step for obs in seen] == list(range(9))
    assert seen[3].image("front").shape == (64, 96, 3)
    assert not np.array_equal(seen[0].image("front"), seen[8].image("front"))


def test_edits_are_seen_by_previews_and_by_sessions_and_can_be_undone(sim):
    scenario = sim.scenarios.create(scene="tiny", name="no red car")
    before = scenario.preview(camera="front", codec="png").data
    scenario.objects["car_red"].delete()
    without = scenario.preview(camera="front", codec="png").data
    assert without != before
    with sim.session(scenario=scenario.scenario_id) as session:
        obs = session.reset(privileged=True)
        assert {a.object_id for a in obs.agents} == {"car_blue", "post"}
    scenario.undo()
    assert scenario.preview(camera="front", codec="png").data == before


def test_a_stale_edit_is_refused_with_what_was_missed(sim):
    mine = sim.scenarios.create(scene="tiny")
    theirs = sim.scenarios.get(mine.scenario_id)
    theirs.objects["post"].translate(x=1.0)
    with pytest.raises(real2sim.StaleRevisionError) as refused:
        mine.objects["post"].translate(x=2.0)
    assert refused.value.missed
    mine.refresh()
    mine.objects["post"].translate(x=2.0)
    assert mine.revision == 2


def test_unknown_names_are_told_with_those_there_are(sim):
    with pytest.raises(real2sim.NotFoundError, match="tiny"):
        sim.scenes.get("nowhere")
    with pytest.raises(real2sim.NotFoundError, match="front"):
        sim.scenes.render("tiny", camera="rear")


def test_depth_and_instances_come_with_the_picture(sim):
    sensor = {"camera": "front", "modalities": ["rgb", "depth", "instance"], "codec": "raw"}
    with sim.session(scene="tiny") as session:
        obs = session.reset(sensors=[sensor])
    depth, instance = obs.image("front", "depth"), obs.image("front", "instance")
    assert depth.dtype == np.float32
    assert instance.dtype == np.uint16
    assert 1 in np.unique(instance)
    assert 5 < np.median(depth[instance == 1]) < 20


def test_the_drive_command_leaves_figures(worker, tmp_path: Path):
    from real2sim.cli import build_app

    figures = tmp_path / "drive.json"
    command = ["drive", "--url", worker.url, "--scene", "tiny", "--steps", "3"]
    result = CliRunner().invoke(build_app(), [*command, "--json", str(figures)])
    assert result.exit_code == 0, result.output
    assert json.loads(figures.read_text())["steps"] == 3


def test_a_log_that_lacks_images_is_reconstructed_edited_and_driven(
    tmp_path: Path, worker_kernels: None
) -> None:
    small = SyntheticConfig(frames=10, width=48, height=32, moving_cars=1, parked_cars=2,
                            lidar_beams=12, lidar_columns=120)  # fmt: skip
    log = write_native_log(generate_log(small), tmp_path / "log")
    for frame in (0, 5):
        (log / f"images/front/{frame:06d}.png").unlink()
    training = replace(preset("cpu-small"), iterations=6, width=48)
    report = reconstruct(log, tmp_path / "scenes/gaps", ReconstructOptions(training=training))
    assert report.left_out == {"images": 2}
    left_out = load_scene(tmp_path / "scenes/gaps").provenance["left_out"]["images"]
    assert left_out["count"] == 2
    assert "images/front/000000.png: cannot be read" in left_out["first"][0]
    settings = Settings(data_dir=tmp_path / "data", scenes_dir=tmp_path / "scenes", port=0,
                        backend="cpu", log_level="error")  # fmt: skip
    with (
        running_worker(settings) as running,
        real2sim.connect(running.url, token=running.token) as sim,
    ):
        scenario = sim.scenarios.create(scene="gaps")
        scenario.objects[min(scenario.objects)].delete()
        with sim.session(scenario=scenario.scenario_id) as session:
            summary = run_episode(session, FollowRoute(speed=5.0), steps=5, sensors=["front"])
    assert summary.steps == 5
