"""Optical flow from depth and poses, in both directions, and what is hidden in the other image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...geometry.transform import invert_transform
from .boxes import ObjectBox
from .images import CameraImages, ids_in

BEHIND = 1e-3
"""What is less far in front of the other camera is behind it [m]."""

BLOCK = np.ones((3, 3), np.uint8)
SAME_SURFACE = 0.03
"""A point is seen in the other image where its depth there differs by at most this share."""


def flow_between(
    here: CameraImages,
    there: CameraImages,
    boxes_here: Sequence[ObjectBox],
    boxes_there: Sequence[ObjectBox],
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Where the surface of each pixel of ``here`` is in the image ``there`` of the same camera.

    Objects are carried by their poses, all else stands still. What has no depth lies infinitely
    far away (sky).

    Returns:
        Flow [H, W, 2] float32 [px]; valid [H, W] bool, False where the surface is behind the
        camera then or its object is no longer there; occluded [H, W] bool, where the flow is valid
        and the other image shows something else at its end, or ends before.
    """
    height, width = here.depth.shape
    columns = np.arange(width, dtype=np.float32) + np.float32(0.5)
    rows = (np.arange(height, dtype=np.float32) + np.float32(0.5))[:, None]
    sky = here.depth == 0
    depth = np.where(sky, np.float32(1), here.depth)
    to_camera = invert_transform(there.T_world_camera)
    still = _Motion.of(to_camera @ here.T_world_camera, here.camera.K, there.camera.K)
    x, y, z = still.carried(columns, rows, depth, (~sky).astype(np.float32))
    there_too = np.ones(here.depth.shape, np.bool_)
    for box, later in _pairs(here, boxes_here, boxes_there):
        own = np.nonzero(here.instance == box.instance_id)
        if later is None:
            there_too[own] = False
            continue
        moved = later.T_world_object @ invert_transform(box.T_world_object)
        motion = _Motion.of(to_camera @ moved @ here.T_world_camera, here.camera.K, there.camera.K)
        places = columns[own[1]], rows[own[0], 0]
        x[own], y[own], z[own] = motion.carried(*places, depth[own], 1.0)
    valid = there_too & (z > BEHIND)
    z[~valid] = 1.0
    x /= z
    y /= z
    flow = np.stack([x - columns, y - rows], axis=-1)
    flow[~valid] = 0
    seen = _seen(there, here.instance, x, y, np.where(sky, np.float32(0), z))
    return flow, valid, valid & ~seen


@dataclass(frozen=True, eq=False)
class _Motion:
    """Where a pixel of known depth goes: ``depth * turn @ (u, v, 1) + shift``."""

    turn: NDArray[np.float32]
    shift: NDArray[np.float32]

    @classmethod
    def of(cls, T_there_here: Float, K_here: Float, K_there: Float) -> _Motion:
        turn = K_there @ T_there_here[:3, :3] @ np.linalg.inv(K_here)
        shift = K_there @ T_there_here[:3, 3]
        return cls(turn.astype(np.float32), shift.astype(np.float32))

    def carried(
        self, u: NDArray[Any], v: NDArray[Any], depth: NDArray[Any], near: NDArray[Any] | float
    ) -> tuple[NDArray[np.float32], ...]:
        """Image places of the other camera times its depth, and that depth; ``near`` is 0 for what
        is infinitely far away."""
        return tuple(
            (row[0] * u + row[1] * v + row[2]) * depth + shift * near
            for row, shift in zip(self.turn, self.shift, strict=True)
        )


def _pairs(
    here: CameraImages, boxes_here: Sequence[ObjectBox], boxes_there: Sequence[ObjectBox]
) -> list[tuple[ObjectBox, ObjectBox | None]]:
    """Each object of the image, and where it is at the other instant; None where it is not."""
    later = {box.instance_id: box for box in boxes_there}
    present = ids_in(here.instance)
    return [(b, later.get(b.instance_id)) for b in boxes_here if b.instance_id in present]


def _seen(
    there: CameraImages,
    instance: NDArray[np.uint16],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    depth: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Whether the other image shows the same surface: the same object at the same depth."""
    height, width = there.depth.shape
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column, row = (np.where(inside, place, np.float32(0)).astype(np.int32) for place in (x, y))
    pixel = row * width + column
    # Metres lie between two rows of a road far away: its surface is met between neighbours.
    low, high = (spread(there.depth, BLOCK).ravel()[pixel] for spread in (cv2.erode, cv2.dilate))
    slack = np.float32(SAME_SURFACE) * depth + np.float32(0.05)
    met = (low - slack <= depth) & (depth <= high + slack) & (depth > 0)
    both_sky = (low == 0) & (depth == 0)
    shown = there.instance.ravel()[pixel]
    same: NDArray[np.bool_] = inside & (met | both_sky) & (shown == instance)
    return same
