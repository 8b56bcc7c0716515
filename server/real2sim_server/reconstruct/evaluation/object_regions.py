"""Where moving objects are on an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...geometry.box import box_corners
from ...geometry.rotation import Float
from ...geometry.transform import apply_transform, invert_transform
from ...logs import DrivingLog, ObjectTrack
from ...scene import Camera

NEAR = 0.2
"""Boxes are cut off at this depth before the camera [m]."""
EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
"""[12, 2] corners at the ends of each edge of a box, in the order of ``box_corners``."""


def moving_tracks(log: DrivingLog) -> tuple[ObjectTrack, ...]:
    """Tracks that lead anywhere, see ``Trajectory.moves``."""
    return tuple(track for track in log.tracks if track.trajectory.moves)


def moving_mask(
    tracks: tuple[ObjectTrack, ...], camera: Camera, T_world_camera: Float, t_us: int
) -> NDArray[np.bool_]:
    """[H, W] bool, pixels whose centre lies within the outline of any box.

    Occlusion by other things is ignored.

    Args:
        tracks: whose boxes count.
        camera: gives size and K.
        T_world_camera: [4, 4], OpenCV camera frame.
        t_us: when [us]; a track just outside its time span counts, see
            ``ObjectTrack.transform_near``.
    """
    mask = np.zeros((camera.height, camera.width), dtype=np.bool_)
    for track in tracks:
        pose = track.transform_near(t_us)
        if pose is not None:
            corners = apply_transform(
                invert_transform(T_world_camera), box_corners(pose, track.size)
            )
            fill_outline(mask, box_outline(corners, camera.K))
    return mask


def box_outline(corners: Float, k: Float) -> Float:
    """Convex hull [P, 2] [px] of a box on the image; empty where it lies behind the camera.

    Args:
        corners: [8, 3] in the camera frame [m], in the order of ``box_corners``.
        k: [3, 3] intrinsics [px].
    """
    import cv2

    start, end = corners[EDGES[:, 0]], corners[EDGES[:, 1]]
    crossing = (start[:, 2] < NEAR) != (end[:, 2] < NEAR)
    start, end = start[crossing], end[crossing]
    fraction = (NEAR - start[:, 2]) / (end[:, 2] - start[:, 2])
    cut = start + fraction[:, None] * (end - start)
    points = np.concatenate([corners[corners[:, 2] >= NEAR], cut])
    if len(points) < 3:
        return np.zeros((0, 2))
    pixels = points @ k.T
    flat = (pixels[:, :2] / pixels[:, 2:]).astype(np.float32)
    return np.asarray(cv2.convexHull(flat)[:, 0], dtype=np.float64)


def fill_outline(mask: NDArray[np.bool_], outline: Float) -> None:
    """Set the pixels of ``mask`` [H, W] whose centre lies in the convex ``outline`` [P, 2] [px]."""
    if len(outline) < 3:
        return
    limit = np.array(mask.shape[::-1])
    low = np.clip(np.floor(outline.min(axis=0)), 0, limit).astype(int)
    high = np.clip(np.ceil(outline.max(axis=0)), 0, limit).astype(int)
    u = np.arange(low[0], high[0])[None, :] + 0.5
    v = np.arange(low[1], high[1])[:, None] + 0.5
    after = np.roll(outline, -1, axis=0)
    sides = after - outline
    area = (outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]).sum()
    inside = np.ones((high[1] - low[1], high[0] - low[0]), dtype=np.bool_)
    for (x, y), (dx, dy) in zip(outline, sides, strict=True):
        inside &= (dx * (v - y) - dy * (u - x)) * np.sign(area) >= 0
    mask[low[1] : high[1], low[0] : high[0]] |= inside
