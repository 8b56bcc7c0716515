"""Box corrections in six degrees of freedom, equal in training and in the export."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.training.model import ObjectPoses
from real2sim_server.scene import Scene


@pytest.fixture
def poses(tiny_scene: Scene, tiny_log) -> ObjectPoses:
    return ObjectPoses(tiny_scene, tiny_log.frame_times_us)


def test_exported_trajectories_have_the_trained_poses(poses: ObjectPoses) -> None:
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        poses.shifts.normal_(std=0.2, generator=random)
        poses.yaws.normal_(std=0.3, generator=random)
        poses.tilts.normal_(std=0.3, generator=random)
    for index, key in enumerate(poses.keys):
        written = poses.trajectory(index)
        for t_us in key.times_us.tolist():
            present, trained = poses.at(t_us)
            pose = trained[present.index(index)].detach().numpy()
            np.testing.assert_allclose(written.transform(t_us), pose, atol=1e-9)


def test_boxes_without_corrections_keep_their_poses(poses: ObjectPoses, tiny_scene: Scene) -> None:
    for index, item in enumerate(tiny_scene.objects.values()):
        t_us = item.trajectory.start_us
        np.testing.assert_allclose(
            poses.trajectory(index).transform(t_us), item.trajectory.transform(t_us), atol=1e-12
        )


def test_roll_lifts_the_left_side_and_pitch_lowers_the_front(poses: ObjectPoses) -> None:
    t_us = int(poses.keys[0].times_us[0])
    _, given = poses.at(t_us)
    for column, axis, sign in ((0, [0.0, 1, 0, 0], 1), (1, [1.0, 0, 0, 0], -1)):
        with torch.no_grad():
            poses.tilts.zero_()
            poses.tilts[:, column] = 0.1
        _, tilted = poses.at(t_us)
        raised = (tilted - given)[0].detach() @ torch.tensor(axis, dtype=torch.float64)
        assert raised[2] * sign == pytest.approx(np.sin(0.1), abs=1e-3)


def test_squares_add_up_per_pose_and_are_averaged(poses: ObjectPoses) -> None:
    assert poses.squares().item() == 0
    with torch.no_grad():
        poses.shifts[:, 1], poses.yaws[::2], poses.tilts[:, 0] = 0.3, 0.2, 0.1
    share = len(poses.yaws[::2]) / len(poses.yaws)
    assert poses.squares().item() == pytest.approx(0.09 + 0.04 * share + 0.01, rel=1e-5)


def test_every_correction_has_a_gradient(poses: ObjectPoses) -> None:
    with torch.no_grad():
        poses.tilts[::2] = 0.1
    present, trained = poses.at(int(poses.keys[0].times_us[1]))
    loss = trained[present.index(0), 2, :3].square().sum() + poses.roughness()
    loss.backward()
    for held in (poses.shifts, poses.yaws, poses.tilts):
        assert held.grad is not None
        assert torch.isfinite(held.grad).all()
    assert poses.tilts.grad.abs().sum() > 0
