"""Which pixels of the background show the ground, told by geometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.semantics import GROUND, STATIC

from ..geometry.rotation import Float
from ..scene import Ground

TOLERANCE = 0.15
"""What is nearer to the ground's height than this shows it [m]."""


def back_projected(depth: NDArray[np.float32], K: Float, T_world_camera: Float) -> Float:
    """Points [H, W, 3] of the world [m] at a depth image [H, W] along the camera's z axis [m]."""
    height, width = depth.shape
    x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    rotation = T_world_camera[:3, :3]
    rays = x[None, :, None] * rotation[:, 0] + y[:, None, None] * rotation[:, 1] + rotation[:, 2]
    points: Float = rays * depth[..., None].astype(np.float64) + T_world_camera[:3, 3]
    return points


def with_ground(
    semantic: NDArray[np.uint8],
    points: Float,
    depth: NDArray[np.float32],
    ground: Ground,
    *,
    tolerance: float = TOLERANCE,
) -> NDArray[np.uint8]:
    """A semantic image [H, W] in which the ground has its own class.

    Args:
        semantic: in which the ground is ``static`` as the rest of the background.
        points: [H, W, 3] of the world at the median depth of the same pass [m].
        depth: [H, W] that depth [m], 0 where nothing is.
        ground: of the scene.
        tolerance: what is nearer to the ground's height shows it [m].
    """
    found = semantic.copy()
    background = (semantic == STATIC) & (depth > 0)
    shown = points[background]
    above = shown[:, 2] - ground.height_at(shown[:, :2])
    found[background] = np.where(np.abs(above) < tolerance, GROUND, STATIC)
    return found
