from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim.planners import LearnedPolicy, load_planner
from real2sim.planners.learned import PolicyShape, network, shrink
from real2sim_server.console import CommandError
from real2sim_server.policies.cloning import (
    CloningDataset,
    PosedImage,
    build_dataset,
    expert_poses,
    scene_images,
    train_network,
)
from real2sim_server.scene.io import save_scene

SHAPE = PolicyShape(camera="front", width=32, height=24, poses=2, spacing=0.5)


def posed_image(*, t_us=0, aside=0.0, turn=0.0) -> PosedImage:
    """An image at a pose relative to the tiny scene's path, which runs along x at 5 m/s."""
    c, s = np.cos(turn), np.sin(turn)
    x = 5.0 * t_us * 1e-6
    pose = np.array([[c, -s, 0, x], [s, c, 0, aside], [0, 0, 1, 0], [0, 0, 0, 1]])
    return PosedImage(np.zeros((24, 32, 3), np.uint8), t_us, pose, 0, 1)


def test_expert_poses_on_the_path_follow_the_recording(tiny_scene):
    answer = expert_poses(tiny_scene.ego, SHAPE, posed_image())
    assert answer * [20, 20, 1] == pytest.approx(np.array([[2.5, 0, 0], [5.0, 0, 0]]), abs=1e-5)


def test_expert_poses_next_to_the_path_lead_back_to_it(tiny_scene):
    long = PolicyShape(camera="front", poses=4, spacing=0.5)
    answer = expert_poses(tiny_scene.ego, long, posed_image(aside=1.0)) * [20, 20, 1]
    assert answer[:, 0] == pytest.approx([2.5, 5.0, 7.5, 10.0], abs=1e-5)
    # The vehicle is 1 m left of the path, so the path is at y = -1.
    assert answer[:, 1] == pytest.approx([-1 + (2 / 3) ** 2, -1 + (1 / 3) ** 2, -1, -1], abs=1e-5)


def test_expert_poses_of_a_turned_view_are_rotated(tiny_scene):
    answer = expert_poses(tiny_scene.ego, SHAPE, posed_image(turn=0.1)) * [20, 20, 1]
    assert answer[:, 2] == pytest.approx([-0.1, -0.1], abs=1e-5)
    assert answer[1, 1] == pytest.approx(-5.0 * np.sin(0.1), abs=1e-5)


def test_views_near_the_end_of_the_recording_are_dropped(tiny_scene):
    assert expert_poses(tiny_scene.ego, SHAPE, posed_image(t_us=1_100_000)) is None
    with pytest.raises(CommandError, match="views"):
        build_dataset(tiny_scene.ego, SHAPE, [posed_image(t_us=1_100_000)])


def test_scene_images_are_rendered_on_and_next_to_the_path(tiny_scene):
    views = list(scene_images(tiny_scene, SHAPE, shifted=2, seed=0))
    assert len(views) == 21 * 3 == views[0].count
    asides = np.array([v.T_world_vehicle[1, 3] for v in views]).reshape(21, 3)
    assert np.abs(asides[:, 0]).max() < 1e-9
    assert 0.3 < np.abs(asides[:, 1:]).mean() < 1.5
    assert views[0].rgb.shape == (43, 64, 3)


def test_an_image_is_shrunk_by_averaging():
    image = np.zeros((8, 12, 3), np.uint8)
    image[:4, :6] = 255
    small = shrink(image, 4, 2)
    assert small.shape == (3, 2, 4)
    assert small[0] == pytest.approx(np.array([[1, 1, -1, -1], [-1] * 4]), abs=1e-5)


def test_shrinking_by_a_non_integer_factor_keeps_the_mean():
    image = np.random.default_rng(0).integers(0, 256, (33, 47, 3), dtype=np.uint8)
    small = shrink(image, 16, 10)
    assert small.mean() == pytest.approx(image.mean() / 127.5 - 1, abs=1e-4)


def dataset() -> CloningDataset:
    """Driven further to the left the brighter the left half is."""
    rng = np.random.default_rng(0)
    side = rng.uniform(-1, 1, 80).astype(np.float32)
    images = np.zeros((80, 3, 24, 32), np.float32)
    images[..., :16], images[..., 16:] = side[:, None, None, None], -side[:, None, None, None]
    poses = np.zeros((80, 2, 3), np.float32)
    poses[:, :, 0], poses[:, :, 1] = 0.25, 0.2 * side[:, None]
    states = np.tile(np.array([0.5, 0, 1, 0], np.float32), (80, 1))
    return CloningDataset(images, states, poses, np.arange(80) % 5 == 4)


def test_training_reduces_the_error_on_unseen_images():
    _, figures = train_network(dataset(), SHAPE, epochs=40)
    untaught = float(np.abs(dataset().poses[..., 1]).mean()) * 20
    assert figures["error_unseen_m"] < 0.3 * untaught


def test_training_is_deterministic_for_a_seed():
    a, b = (train_network(dataset(), SHAPE, epochs=1, seed=3)[0] for _ in range(2))
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_a_drive_too_short_for_its_plans_is_refused(tiny_scene, tmp_path):
    save_scene(tiny_scene, tmp_path / "tiny")
    file, figures = tmp_path / "policy.safetensors", tmp_path / "figures.json"
    done = CliRunner().invoke(
        build_app(),
        [
            *("train-policy", str(tmp_path / "tiny"), "--out", str(file)),
            *("--epochs", "1", "--shifted", "0", "--json", str(figures), "--camera", "left"),
        ],
    )
    # Two seconds are too short for three-second plans.
    assert done.exit_code == 1
    assert "views" in done.output


def test_a_policy_is_loaded_from_its_weights_file(tmp_path):
    from safetensors.torch import save_file

    file, model = tmp_path / "policy.safetensors", network(SHAPE)
    save_file(dict(model.state_dict()), file, metadata=SHAPE.metadata())
    policy = load_planner(f"learned={file}")
    assert isinstance(policy, LearnedPolicy)
    assert policy.shape == SHAPE
    assert policy.needs.cameras == ("front",)


def test_a_file_without_a_policy_is_refused(tmp_path):
    from safetensors.torch import save_file

    file = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(2)}, file, metadata={"format": "pt"})
    with pytest.raises(ValueError, match="holds no policy"):
        LearnedPolicy(file)
    file.write_bytes(json.dumps({}).encode())
    with pytest.raises(ValueError, match="holds no policy"):
        LearnedPolicy(file)
