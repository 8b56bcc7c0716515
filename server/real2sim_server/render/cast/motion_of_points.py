"""How fast what a ray meets moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...geometry.transform import apply_transform, invert_transform
from .types import CastRequest, Echo, Image


def point_velocities(request: CastRequest, echo: Echo, hit: NDArray[np.bool_]) -> Image:
    """Velocity [..., 3] [m/s] in the world of the point that each ray meets; 0 elsewhere.

    That of the body's own motion between the instants before and after the ray's.
    """
    lidar = request.lidar
    times, slots = lidar.beams.slots
    velocity = np.zeros((*lidar.shape, 3), np.float32)
    if len(times) < 2:
        return velocity
    before = np.clip(slots - 1, 0, len(times) - 1)
    after = np.clip(slots + 1, 0, len(times) - 1)
    firsts = np.cumsum([0, *(len(i.cloud) for i in request.instances)])
    for index, poses in enumerate(request.object_poses):
        if poses is None:
            continue
        of_body = (echo.member >= firsts[index]) & (echo.member < firsts[index + 1]) & hit
        if not of_body.any():
            continue
        slot = slots[of_body]
        ray = (lidar.beams.directions * echo.range[..., None])[of_body]
        world = _each(request.T_world_lidar[slot], ray)
        local = _each(invert_transform(poses[slot]), world)
        moved = _each(poses[after[of_body]], local) - _each(poses[before[of_body]], local)
        seconds = (times[after[of_body]] - times[before[of_body]]) * 1e-6
        velocity[of_body] = moved / seconds[:, None]
    return velocity


def _each(transforms: Float, points: Float) -> Float:
    """Points [N, 3], each by its own transform [N, 4, 4]."""
    moved: Float = apply_transform(transforms, points[:, None])[:, 0]
    return moved
