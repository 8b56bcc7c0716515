"""Boxes with noise: made for tests, and smoothed before anything is built from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import (
    Float,
    multiply_quaternions,
    quaternion_to_matrix,
    quaternion_yaw,
    yaw_quaternion,
)
from ...logs import DrivingLog, ObjectTrack
from ...scene import Trajectory

ACCELERATION, YAW_ACCELERATION = 2.0, 0.6
"""What vehicles usually do: standard deviations [m/s^2] and [rad/s^2]."""
MIN_NOISE, MIN_YAW_NOISE = 0.02, 0.005
"""Boxes that scatter less are left as they are [m], [rad]."""
MIN_POSES = 5


def with_box_noise(log: DrivingLog, fraction: float, *, seed: int = 0) -> DrivingLog:
    """``log`` with boxes that scatter independently from frame to frame.

    Args:
        fraction: standard deviation of positions as a fraction of the box's length, width and
            height along its own axes, and of headings [rad].
    """
    tracks = []
    for index, track in enumerate(log.tracks):
        rng = np.random.default_rng([seed, index])
        given = track.trajectory
        count = len(given.times_us)
        shift = rng.standard_normal((count, 3)) * (fraction * np.array(track.size))
        rotations = quaternion_to_matrix(given.quaternions)
        tracks.append(
            _with_poses(
                track,
                given.positions + np.einsum("tij,tj->ti", rotations, shift),
                rng.standard_normal(count) * fraction,
            )
        )
    return replace(log, tracks=tuple(tracks))


def smoothed_boxes(log: DrivingLog) -> DrivingLog:
    """``log`` with the scatter of its boxes taken out, as far as vehicles cannot move like that.

    The variance of second differences shows how much boxes scatter; where that is more than
    driving explains, positions and headings are smoothed with the weight that follows from both
    (Whittaker 1923). Boxes that do not scatter stay as they are, to the bit.
    """
    return replace(log, tracks=tuple(_smoothed(track) for track in log.tracks))


def _smoothed(track: ObjectTrack) -> ObjectTrack:
    given = track.trajectory
    if len(given.times_us) < MIN_POSES:
        return track
    step = float(np.median(np.diff(given.times_us))) * 1e-6
    heading = np.unwrap(quaternion_yaw(given.quaternions))
    smooth = _whittaker(given.positions, ACCELERATION * step**2, MIN_NOISE)
    turned = _whittaker(heading[:, None], YAW_ACCELERATION * step**2, MIN_YAW_NOISE)[:, 0]
    if smooth is given.positions and np.array_equal(turned, heading):
        return track
    return _with_poses(track, smooth, turned - heading)


def _whittaker(values: Float, driving: float, least: float) -> Float:
    """``values`` [T, D] smoothed; themselves where they scatter by less than ``least``.

    Args:
        driving: standard deviation of second differences without any scatter.
    """
    second = np.diff(values, n=2, axis=0)
    # Robust against the few steps at which a driver brakes hard.
    deviation = 1.4826 * np.median(np.abs(second), axis=0)
    variance = max(0.0, float((deviation**2).mean()) - driving**2) / 6
    if variance < least**2:
        return values
    difference: NDArray[np.float64] = np.diff(np.eye(len(values)), n=2, axis=0)
    weight = variance / driving**2
    system = np.eye(len(values)) + weight * difference.T @ difference
    return np.asarray(np.linalg.solve(system, values))


def _with_poses(track: ObjectTrack, positions: Float, yaws: Float) -> ObjectTrack:
    given = track.trajectory
    quaternions = multiply_quaternions(yaw_quaternion(yaws), given.quaternions)
    return replace(track, trajectory=Trajectory(given.times_us, positions, quaternions))
