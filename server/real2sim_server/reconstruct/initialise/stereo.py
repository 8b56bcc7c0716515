"""Points from the images where no LiDAR beam went, densely: crowns of trees, upper walls, roofs.

A camera that drives sees the same place from many positions. Planes are swept through the view of
each image (Collins 1996); the depth at which its neighbours look alike there is that of what it
shows, if the depths of its neighbours agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float, apply_transform, invert_transform
from ...logs import DrivingLog
from ...scene import Camera
from ..logged_view import resized, still_surfaces
from .triangulate import spread_frames

WIDTH = 320
"""Images are compared at this width [px]; depths are some percent right then."""
BASELINES = (0.8, 1.6)
"""Each image is compared with those taken about so far before and after it [m]."""
PLANES = 96
NEAREST, FARTHEST = 4.0, 90.0
"""Depths of the planes, evenly spread by their inverse [m]."""
WINDOW = 5
"""Edge of the squares whose likeness counts [px]."""
LEAST_CONTRAST = 2.0
"""Standard deviation of brightness in a square, 0 to 255, below which nothing can be told."""
LEAST_LIKENESS = 0.6
"""Normalised cross-correlation of squares, mean of the two best neighbours."""
CLEARNESS, APART = 0.05, 3
"""The best plane is so much better than any more than so many planes away."""
AGREEMENT = 0.03
"""Depths of two images agree to this share."""
AGREEING = 2
"""Other images whose depth must agree."""
MARGIN = 0.03
"""Of the image's height, which is compared below the highest LiDAR returns."""

_Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class _View:
    """One image and, once known, its depths.

    Attributes:
        grey: [H, W] float32, 0 to 255.
        free: [H, W] bool, outside of the sky and of the boxes of objects.
        K: [3, 3] at this size.
        pose: [4, 4] ``T_world_camera``.
        rows: those from the top that are compared.
    """

    grey: NDArray[np.float32]
    free: NDArray[np.bool_]
    K: Float
    pose: Float
    rows: int


def sweep_planes(log: DrivingLog, *, max_images: int, on_image: _Progress) -> NDArray[np.float32]:
    """Points [N, 3] float32 of what stands still above the LiDAR's reach, world frame [m].

    Args:
        log: with calibrated cameras and poses; of cameras that are no pinholes nothing is taken.
        max_images: of each camera at most, evenly spread.
        on_image: called with the images done and all.
    """
    cameras = [camera for camera in log.rig if camera.is_pinhole]
    chosen = {camera.name: spread_frames(log, camera, max_images) for camera in cameras}
    total, done, found = sum(map(len, chosen.values())), 0, []
    for camera in cameras:
        views = [_read(log, camera, frame) for frame in chosen[camera.name]]
        depths = []
        for view in views:
            depths.append(_depths(view, _neighbours(view, views)))
            done += 1
            on_image(done, total)
        found += [_agreed(k, views, depths) for k in range(len(views))]
    points = np.concatenate([np.zeros((0, 3)), *found])
    return points.astype(np.float32)


def _read(log: DrivingLog, camera: Camera, frame: int) -> _View:
    import cv2

    small = camera.resized(min(WIDTH, camera.width))
    image = resized(log.image(camera.name, frame), small)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    pose = camera.pose(log.ego.transform(log.image_time_us(camera.name, frame)))
    free = still_surfaces(log, small, frame, image)
    return _View(grey, free, small.K, pose, _rows(log, small, frame))


def _rows(log: DrivingLog, camera: Camera, frame: int) -> int:
    """Rows from the top down to the highest returns of LiDAR."""
    to_camera = invert_transform(camera.T_vehicle_camera)
    x, y, z = apply_transform(to_camera, log.lidar(frame).points.astype(np.float64)).T
    ahead = z > 1
    u, v = (camera.K[i, i] * a[ahead] / z[ahead] + camera.K[i, 2] for i, a in ((0, x), (1, y)))
    hit = v[(u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)]
    highest = float(np.quantile(hit, 0.01)) if len(hit) else camera.height
    return max(WINDOW, min(camera.height, round(highest + MARGIN * camera.height)))


def _neighbours(view: _View, views: list[_View]) -> list[_View]:
    """Those nearest to each of BASELINES, before and after."""
    offsets = np.array([v.pose[:3, 3] - view.pose[:3, 3] for v in views])
    distance = np.linalg.norm(offsets, axis=1)
    mine = next(k for k, v in enumerate(views) if v is view)
    later = np.arange(len(views)) > mine
    picked: list[int] = []
    for side in (later, ~later & (distance > 0)):
        for baseline in BASELINES:
            near = np.flatnonzero(side & (distance > 0.5 * baseline) & (distance < 2 * baseline))
            if len(near):
                picked.append(int(near[np.abs(distance[near] - baseline).argmin()]))
    return [views[k] for k in sorted(set(picked))]


def _depths(view: _View, neighbours: list[_View]) -> NDArray[np.float32]:
    """Depths [rows, W] of an image [m], 0 where they are not clear."""
    rows, width = view.rows, view.grey.shape[1]
    none = np.zeros((rows, width), np.float32)
    if len(neighbours) < 2:
        return none
    own = view.grey[:rows]
    mean, spread = _moments(own)
    inverse = np.linspace(1 / FARTHEST, 1 / NEAREST, PLANES)
    scores = np.empty((PLANES, rows, width), np.float32)
    for k, d in enumerate(inverse):
        alike = np.stack([_likeness(view, n, 1 / d, own, mean, spread) for n in neighbours])
        scores[k] = np.partition(alike, -2, axis=0)[-2:].mean(0)
    best = scores.argmax(0)
    top = np.take_along_axis(scores, best[None], 0)[0]
    away = np.abs(np.arange(PLANES)[:, None, None] - best) > APART
    second = np.where(away, scores, -1).max(0)
    clear = (top > LEAST_LIKENESS) & (top - second > CLEARNESS) & (spread > LEAST_CONTRAST)
    clear &= (best > 0) & (best < PLANES - 1) & view.free[:rows]
    inner = best.clip(1, PLANES - 2)
    low, high = (np.take_along_axis(scores, inner[None] + s, 0)[0] for s in (-1, 1))
    bend = np.minimum(low + high - 2 * top, -1e-6)
    place = inner + np.clip(0.5 * (low - high) / bend, -0.5, 0.5)
    depth = 1 / np.interp(place, np.arange(PLANES), inverse)
    return np.where(clear, depth, none).astype(np.float32)


def _moments(grey: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and standard deviation in the squares about all pixels."""
    import cv2

    mean = cv2.boxFilter(grey, -1, (WINDOW, WINDOW))
    square = cv2.boxFilter(grey * grey, -1, (WINDOW, WINDOW))
    return np.asarray(mean), np.sqrt(np.maximum(square - mean * mean, 0))


def _likeness(  # noqa: PLR0917 - what is the same for all planes is given along
    view: _View,
    other: _View,
    depth: float,
    own: NDArray[np.float32],
    mean: NDArray[np.float32],
    spread: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Correlation [rows, W] of squares, if all that ``view`` shows were at ``depth`` [m]; -1
    where the other image does not show it."""
    import cv2

    relative = invert_transform(other.pose) @ view.pose
    plane = relative[:3, :3] + np.outer(relative[:3, 3], [0.0, 0.0, 1 / depth])
    # Pixel centres are at a half here and at whole numbers in OpenCV.
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    homography = np.linalg.inv(half) @ other.K @ plane @ np.linalg.inv(view.K) @ half
    rows, width = own.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shown = cv2.warpPerspective(
        other.grey, homography, (width, rows), flags=flags, borderValue=-1e4
    )
    seen = shown > -1
    warped = np.where(seen, shown, 0).astype(np.float32)
    theirs, contrast = _moments(warped)
    product = cv2.boxFilter(own * warped, -1, (WINDOW, WINDOW)) - mean * theirs
    alike = product / np.maximum(spread * contrast, LEAST_CONTRAST)
    return np.where(seen, alike, -1).astype(np.float32)


def _agreed(index: int, views: list[_View], depths: list[NDArray[np.float32]]) -> Float:
    """World points [N, 3] of an image whose depth other images share."""
    view, depth = views[index], depths[index]
    row, column = np.nonzero(depth)
    pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], 1)
    points = (pixels @ np.linalg.inv(view.K).T) * depth[row, column, None]
    world = apply_transform(view.pose, points)
    count = np.zeros(len(world), np.int64)
    for other in range(max(0, index - 3), min(len(views), index + 4)):
        if other != index:
            count += _agrees(world, views[other], depths[other])
    return world[count >= AGREEING]


def _agrees(points: Float, view: _View, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which points [N, 3] lie where an image has its depths."""
    local = apply_transform(invert_transform(view.pose), points)
    z = np.maximum(local[:, 2], 1e-3)
    pixels = (local @ view.K.T)[:, :2] / z[:, None]
    u, v = np.floor(pixels).astype(np.int64).T
    inside = (local[:, 2] > 1) & (u >= 0) & (u < depth.shape[1]) & (v >= 0) & (v < depth.shape[0])
    found = np.zeros(len(points), np.bool_)
    theirs = depth[v[inside], u[inside]]
    found[inside] = np.abs(theirs - z[inside]) < AGREEMENT * z[inside]
    return found
