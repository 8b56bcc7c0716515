"""Brings the points of one LiDAR sweep to one instant, by the vehicle's own motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...geometry.transform import invert_transform


def compensate_sweep(
    points: Float, offset: Float, vehicle_poses: Float, frame: int
) -> NDArray[np.float32]:
    """Points as if all had been measured at the frame's time stamp, were the world static.

    Between frames the vehicle moves with constant velocity and constant angular velocity;
    before the first and after the last frame it goes on as in the nearest interval.

    Args:
        points: [N, 3] float64, vehicle frame at each point's own instant [m].
        offset: [N] float64, that instant relative to the frame's, in frame periods.
        vehicle_poses: ``T_world_vehicle`` [F, 4, 4] of all frames.
        frame: index of the frame.

    Returns:
        [N, 3] float32, vehicle frame at the frame's time stamp [m].
    """
    moved = points.copy()
    for direction in (-1, 1):
        chosen = offset < 0 if direction < 0 else offset > 0
        motion = _motion(vehicle_poses, frame, direction)
        moved[chosen] = _advance(points[chosen], np.abs(offset[chosen]), motion)
    return moved.astype(np.float32)


def _motion(vehicle_poses: Float, frame: int, direction: int) -> Float:
    """``T_here_there`` [4, 4] of the neighbouring frame, mirrored at the ends of the log."""
    here = invert_transform(vehicle_poses[frame])
    if 0 <= frame + direction < len(vehicle_poses):
        towards: Float = here @ vehicle_poses[frame + direction]
        return towards
    if len(vehicle_poses) == 1:
        return np.eye(4)
    return invert_transform(here @ vehicle_poses[frame - direction])


def _advance(points: Float, fraction: Float, motion: Float) -> Float:
    """Apply ``fraction`` [N] of a rigid motion to points [N, 3] (Rodrigues' formula)."""
    rotation = motion[:3, :3]
    angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    length = np.linalg.norm(skew)
    shift = fraction[:, None] * motion[:3, 3]
    if length < 1e-12:
        return points + shift
    axis = skew / length
    turn = (fraction * angle)[:, None]
    cross = np.cross(axis, points)
    along = (points @ axis)[:, None] * axis
    turned: Float = points * np.cos(turn) + cross * np.sin(turn) + along * (1 - np.cos(turn))
    return turned + shift
