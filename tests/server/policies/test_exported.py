"""Training examples from exported data sets."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim.planners.learned import PolicyShape
from real2sim_server.console import CommandError
from real2sim_server.datasets.clips import Clip
from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.perturbed import Perturbation
from real2sim_server.datasets.plan import ExportPlan
from real2sim_server.edit import ScenarioState
from real2sim_server.policies.cloning import exported_examples, exported_shape

SHAPE = PolicyShape(camera="front", width=32, height=24, poses=2, spacing=0.5)
PLAN = ExportPlan(
    formats=("labels",),
    cameras=("front",),
    period_us=100_000,
    end_us=900_000,
    clip_s=0.5,
    flow=False,
    perturb=Perturbation(lateral_sigma=0.5, heading_sigma=0.05, recover_s=1.0),
)


@pytest.fixture(scope="module")
def beside(tiny_scene, tmp_path_factory):
    drive = ScenarioDrive(tiny_scene, ScenarioState.of(tiny_scene))
    return export_dataset(drive, PLAN, tmp_path_factory.mktemp("set") / "beside")


def test_labelled_plans_are_the_training_targets(beside):
    found = exported_examples([beside], SHAPE)
    assert found.images.shape == (10, 3, 24, 32)
    assert found.poses.shape == (10, 2, 3)
    # Half a second and a second at about 5 m/s, off the path and back.
    assert found.poses[:, :, 0] * 20 == pytest.approx(np.tile([2.5, 5.0], (10, 1)), abs=0.2)
    assert np.abs(found.poses[:, 1, 1]).max() * 20 > 0.1


def test_speed_and_command_are_read_from_the_frame(beside):
    states = exported_examples([beside], SHAPE).states
    assert states[:, 0] * 10 == pytest.approx(np.full(10, 5.0), abs=0.15)
    assert (states[:, 1:] == [0, 1, 0]).all()


def test_the_exported_route_starts_at_the_next_waypoint(beside):
    frames = Clip.open(beside / "labels" / "0001").frames
    assert np.shape(frames[0]["ego"]["route"]) == (20, 2)
    # Back on the path, the next waypoint is 2 m ahead.
    assert frames[-1]["ego"]["route"][0] == pytest.approx([2.0, 0.0], abs=0.15)


def test_every_fifth_frame_of_a_clip_is_held_out(beside):
    assert np.flatnonzero(exported_examples([beside], SHAPE).held_out).tolist() == [4, 9]


def test_the_front_camera_is_the_default(beside):
    assert exported_shape(beside, None).camera == "front"
    with pytest.raises(CommandError, match="no camera 'rear'"):
        exported_shape(beside, "rear")


def test_an_export_too_short_for_the_plans_is_refused(beside, tmp_path):
    out = str(tmp_path / "policy.safetensors")
    done = CliRunner().invoke(build_app(), ["train-policy", str(beside), str(beside), "-o", out])
    assert done.exit_code == 1
    assert "0 frames have 3 s" in done.output


def test_an_export_without_labels_is_refused(tmp_path):
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(CommandError, match="--format labels"):
        exported_shape(tmp_path, None)
