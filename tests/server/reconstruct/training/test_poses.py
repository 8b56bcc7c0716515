"""Box corrections in six degrees of freedom, equal in training and in the export."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.training.model import ObjectPoses
from real2sim_server.scene import Scene, Trajectory


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


def test_squares_measure_the_distance_by_which_corrections_move_a_box(tiny_scene: Scene) -> None:
    name, item = next(iter(tiny_scene.objects.items()))
    one = replace(tiny_scene, objects={name: replace(item, size=(4.0, 2.0, 1.5))})
    poses = ObjectPoses(one, None)
    assert poses.squares().item() == 0
    with torch.no_grad():
        poses.shifts[:, 1] = 0.3
        roll, pitch, yaw = 0.1, 0.2, 0.05
        poses.tilts[:] = torch.tensor([roll, pitch])
        poses.yaws[::2] = yaw
    share = len(poses.yaws[::2]) / len(poses.yaws)
    ends = roll**2 + (2 * pitch) ** 2 + (2 * yaw) ** 2 * share
    assert poses.squares().item() == pytest.approx(0.09 + ends, rel=1e-5)


def test_an_object_that_stands_still_keeps_its_pose(tiny_scene: Scene, tiny_log) -> None:
    (name, item), *others = tiny_scene.objects.items()
    given = item.trajectory
    still = Trajectory(
        given.times_us, *(np.tile(p[0], (len(p), 1)) for p in (given.positions, given.quaternions))
    )
    objects = {name: replace(item, trajectory=still)} | dict(others[:1])
    poses = ObjectPoses(replace(tiny_scene, objects=objects), tiny_log.frame_times_us)
    with torch.no_grad():
        for held in (poses.shifts, poses.yaws, poses.tilts):
            held.add_(0.3)
    present, trained = poses.at(still.end_us)
    assert present == [0, 1]
    np.testing.assert_array_equal(trained[0].detach(), still.transform(still.end_us))
    np.testing.assert_array_equal(poses.trajectory(0).positions[-1], still.positions[0])
    alone = ObjectPoses(replace(tiny_scene, objects={name: objects[name]}), None)
    assert alone.squares().item() == alone.roughness().item() == 0
    assert len(alone.at(still.start_us)[0]) == 1


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
