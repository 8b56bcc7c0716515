"""One image of a log: when it was taken, and where LiDAR points and objects are on it."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import NDArray

from ..geometry.box import box_corners
from ..geometry.transform import Float, apply_transform, invert_transform
from ..logs import DrivingLog, LidarSweep, ObjectTrack
from ..scene import Camera, Scene

NEAR = 0.2
"""Boxes are cut off at this depth in front of the camera [m]."""
EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
"""[12, 2] corners at the ends of each edge of a box, in the order of ``box_corners``."""


def image_time(log: DrivingLog, camera: str, frame: int) -> int:
    """When the image was taken [us], held to the span of the ego path."""
    t_us = log.image_time_us(camera, frame)
    return int(min(max(t_us, log.ego.start_us), log.ego.end_us))


def resized(image: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """``image`` at the size of ``camera``."""
    import cv2

    if image.shape[:2] == (camera.height, camera.width):
        return image
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def points_in_camera(
    log: DrivingLog, camera: Camera, frame: int, t_us: int, *, sweep: LidarSweep | None = None
) -> Float:
    """The sweep of ``frame`` [N, 3] [m] in the frame of ``camera`` as it stood at ``t_us``.

    The motion of the recording vehicle between sweep and image is taken out. That of other
    vehicles is not: it is a few decimetres at most, on few points.

    Args:
        sweep: of ``frame``; None reads it.
    """
    T_world_vehicle = log.ego.transform(int(log.frame_times_us[frame]))
    T_camera_vehicle = camera.viewmat(log.ego.transform(t_us)) @ T_world_vehicle
    points = (log.lidar(frame) if sweep is None else sweep).points
    return apply_transform(T_camera_vehicle, points)


def moving_tracks(log: DrivingLog) -> tuple[ObjectTrack, ...]:
    """Tracks that lead anywhere, see ``Trajectory.moves``."""
    return tuple(track for track in log.tracks if track.trajectory.moves)


def tracks_mask(
    tracks: Iterable[ObjectTrack],
    camera: Camera,
    T_world_camera: Float,
    t_us: int,
    *,
    margin: float = 0.0,
) -> NDArray[np.bool_]:
    """[H, W] bool, pixels whose centre lies within the outline of any box.

    Occlusion by other things is ignored.

    Args:
        tracks: whose boxes count.
        camera: gives size and K.
        T_world_camera: [4, 4], OpenCV camera frame.
        t_us: when [us]; a track just outside its time span counts, see
            ``ObjectTrack.transform_near``.
        margin: by which boxes grow on every side [m].
    """
    poses = [(track.transform_near(t_us), track.size) for track in tracks]
    boxes = [box_corners(T, np.add(size, 2 * margin)) for T, size in poses if T is not None]
    return _boxes_mask(boxes, camera, T_world_camera)


def objects_mask(
    scene: Scene, camera: Camera, t_us: int, *, only: Collection[str] | None = None
) -> NDArray[np.bool_]:
    """:func:`tracks_mask` of the objects of a scene, seen from its recording vehicle.

    Args:
        only: ids of the objects that count; all by default.
    """
    objects = [o for name, o in scene.objects.items() if only is None or name in only]
    boxes = [o.box_at(t_us) for o in objects if o.trajectory.covers(t_us)]
    return _boxes_mask(boxes, camera, camera.pose(scene.ego.transform(t_us)))


def _boxes_mask(boxes: Iterable[Float], camera: Camera, T_world_camera: Float) -> NDArray[np.bool_]:
    mask = np.zeros((camera.height, camera.width), dtype=np.bool_)
    T_camera_world = invert_transform(T_world_camera)
    for corners in boxes:
        fill_outline(mask, box_outline(apply_transform(T_camera_world, corners), camera.K))
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
