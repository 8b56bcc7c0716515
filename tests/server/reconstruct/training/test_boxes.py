from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.logs import ObjectTrack
from real2sim_server.reconstruct.training import (
    DensifyOptions,
    LearningRates,
    Trainer,
    smoothed_boxes,
    with_box_noise,
)
from real2sim_server.reconstruct.training.run import one_torch_thread
from real2sim_server.scene import Scene, SceneObject, Trajectory

from .conftest import TINY


def errors(log, truth) -> list[float]:
    return [
        float(np.linalg.norm(a.trajectory.positions - b.trajectory.positions, axis=1).mean())
        for a, b in zip(log.tracks, truth.tracks, strict=True)
    ]


@pytest.fixture(scope="module")
def long_log():
    from real2sim_server.synthetic import SyntheticConfig, generate_log

    return generate_log(SyntheticConfig(seed=2, frames=50, parked_cars=0))


def test_exact_boxes_are_unchanged(long_log):
    smooth = smoothed_boxes(long_log)
    assert max(errors(smooth, long_log)) == 0


def test_smoothing_reduces_box_noise(long_log):
    noisy = with_box_noise(long_log, 0.05, seed=1)
    given, smooth = errors(noisy, long_log), errors(smoothed_boxes(noisy), long_log)
    assert min(given) > 0.1
    assert max(s / g for s, g in zip(smooth, given, strict=True)) < 0.5


@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_only_objects_that_do_not_move_get_one_pose(long_log, speed):
    log = replace(long_log, tracks=(_drifting(long_log.tracks[0], speed),))
    [noisy] = with_box_noise(log, 0.02, seed=1).tracks
    [smooth] = smoothed_boxes(replace(log, tracks=(noisy,))).tracks
    poses = smooth.trajectory
    stands = not np.ptp(np.concatenate([poses.positions, poses.quaternions], axis=1), axis=0).any()
    assert stands == (speed == 0)
    true = log.tracks[0].trajectory
    off, given = (
        np.mean([np.linalg.norm(p - true.pose(int(t))[0]) for t, p in zip(*poses, strict=True)])
        for poses in ((t.times_us, t.positions) for t in (smooth.trajectory, noisy.trajectory))
    )
    assert off < 0.6 * given


def test_box_noise_depends_only_on_the_seed(long_log):
    first, again = (with_box_noise(long_log, 0.05, seed=1) for _ in range(2))
    other = with_box_noise(long_log, 0.05, seed=2)
    assert max(errors(first, again)) == 0
    assert min(errors(first, other)) > 0.05


def test_training_corrects_a_shifted_box(tiny_log, tiny_scene):
    name = max(tiny_scene.objects, key=lambda k: _nearness(tiny_log, tiny_scene.objects[k]))
    shifted = _shifted(tiny_scene, name, 0.25)
    options = replace(
        TINY,
        iterations=80,
        hold_out=0,
        pose_start=0.0,
        harmonics=0,
        learning_rates=LearningRates(
            means=(0.0, 0.0),
            scales=0.0,
            quats=0.0,
            opacities=0.0,
            colour=0.0,
            sky=(0.0, 0.0),
            pose_translation=(0.04, 0.01),
            pose_yaw=(1e-9, 1e-9),
        ),
        densify=DensifyOptions(method="none"),
    )
    trainer = Trainer(tiny_log, shifted, options)
    with one_torch_thread():
        trainer.run()
    trainer.views.close()
    truth = tiny_scene.objects[name].trajectory
    refined = trainer.model.export().objects[name].trajectory
    off = np.array([refined.pose(int(t))[0] - truth.pose(int(t))[0] for t in truth.times_us])
    inner = off[1:-1, 1]
    assert np.abs(inner).mean() < 0.15
    assert torch.isfinite(trainer.model.poses.shifts).all()


def _nearness(log, item: SceneObject) -> float:
    """Inverse distance of an object ahead of the ego [1/m], 0 if it is not ahead."""
    t_us = int(log.frame_times_us[3])
    if not item.trajectory.covers(t_us):
        return 0.0
    ego = log.ego.transform(t_us)
    local = ego[:3, :3].T @ (item.trajectory.pose(t_us)[0] - ego[:3, 3])
    return 1 / local[0] if local[0] > 4 and abs(local[1]) < 0.5 * local[0] else 0.0


def _drifting(track: ObjectTrack, speed: float) -> ObjectTrack:
    """``track`` at its first pose, moved along y at ``speed`` [m/s]; two poses."""
    given = track.trajectory
    times = np.array([given.start_us, given.end_us])
    gone = np.array([[0, 0, 0], [0, speed * np.ptp(times) * 1e-6, 0]])
    poses = Trajectory(times, given.positions[0] + gone, np.tile(given.quaternions[0], (2, 1)))
    return replace(track, trajectory=poses)


def _shifted(scene: Scene, name: str, left: float) -> Scene:
    item = scene.objects[name]
    given = item.trajectory
    moved = Trajectory(given.times_us, given.positions + np.array([0, left, 0]), given.quaternions)
    objects = dict(scene.objects) | {name: replace(item, trajectory=moved)}
    return replace(scene, objects=objects)
