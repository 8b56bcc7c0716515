"""Which pixels of the background show the ground, told by geometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.semantics import GROUND, STATIC

from ..geometry.rotation import Float
from ..scene import Camera, Ground
from .lens_view import tables_of

TOLERANCE = 0.15
"""What is nearer to the ground's height than this shows it [m]."""


def back_projected(
    depth: NDArray[np.float32], K: Float, T_world_camera: Float
) -> NDArray[np.float32]:
    """Points [H, W, 3] of the world [m] at a depth image [H, W] along the camera's z axis [m]."""
    height, width = depth.shape
    x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    points = np.empty((height, width, 3), np.float32)
    for axis, (right, down, ahead, shift) in enumerate(T_world_camera[:3]):
        across, along = (x * right + ahead).astype(np.float32), (y * down).astype(np.float32)
        points[..., axis] = (across + along[:, None]) * depth + np.float32(shift)
    return points


def with_ground(
    semantic: NDArray[np.uint8],
    points: NDArray[np.float32],
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


def with_ground_seen(
    semantic: NDArray[np.uint8],
    depth: NDArray[np.float32],
    camera: Camera,
    T_world_camera: Float,
    ground: Ground,
) -> NDArray[np.uint8]:
    """The same by any camera, also with a lens; points are found of the background alone.

    Args:
        semantic: [H, W], in which the ground is ``static``.
        depth: [H, W] median depth of the same pass, as the camera's lens has it [m].
        camera: that looks.
        T_world_camera: [4, 4], in the middle of a read-out.
        ground: of the scene.
    """
    found = semantic.copy()
    rows, columns = np.nonzero((semantic == STATIC) & (depth > 0))
    points = _rays(camera, rows, columns) * depth[rows, columns, None]
    turn = T_world_camera[:3, :3].astype(np.float32)
    shown = points @ turn.T + T_world_camera[:3, 3].astype(np.float32)
    near = np.abs(shown[:, 2] - ground.height_at(shown[:, :2])) < TOLERANCE
    found[rows[near], columns[near]] = GROUND
    return found


def _rays(camera: Camera, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
    """Of pixels, [P, 3] in the camera's frame, to where its depth images have depth 1."""
    if camera.is_pinhole:
        K = camera.K
        x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
        return np.stack([x, y, np.ones(len(x))], axis=-1).astype(np.float32)
    rays: NDArray[np.float32] = tables_of(camera).rays[rows, columns]
    if camera.lens is None or camera.lens.perspective:
        rays = (rays / np.maximum(rays[:, 2:], 1e-6)).astype(np.float32)
    return rays
