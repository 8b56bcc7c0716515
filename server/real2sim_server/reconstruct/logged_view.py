"""Logged images: their time, LiDAR points and objects, the sky and static surfaces in them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float, apply_transform, box_corners, invert_transform
from ..logs import DrivingLog, LidarSweep, ObjectTrack
from ..scene import Camera, Scene

T = TypeVar("T")

# Image time, and LiDAR points and objects in an image.

NEAR = 0.2
"""Boxes are cut off at this depth in front of the camera [m]."""
EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
"""[12, 2] corners at the ends of each edge of a box, in the order of ``box_corners``."""


def spread(items: Sequence[T], limit: int) -> list[T]:
    """At most ``limit`` of ``items``, evenly spread, including the first and the last."""
    places = np.linspace(0, len(items) - 1, min(limit, len(items)))
    return [items[round(place)] for place in places]


def image_time(log: DrivingLog, camera: str, frame: int) -> int:
    """Time of the image, clamped to the span of the ego path [us]."""
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
    """The sweep of ``frame`` [N, 3] [m] in the frame of ``camera`` at its pose at ``t_us``.

    Compensates the motion of the recording vehicle between sweep and image. The motion of other
    vehicles is not compensated: it is a few decimetres at most, on few points.

    Args:
        sweep: sweep of ``frame``; None reads it.
    """
    T_world_vehicle = log.ego.transform(int(log.frame_times_us[frame]))
    T_camera_vehicle = camera.viewmat(log.ego.transform(t_us)) @ T_world_vehicle
    points = (log.lidar(frame) if sweep is None else sweep).points
    return apply_transform(T_camera_vehicle, points)


def moving_tracks(log: DrivingLog) -> tuple[ObjectTrack, ...]:
    """Moving tracks, see ``Trajectory.moves``."""
    return tuple(track for track in log.tracks if track.trajectory.moves)


def tracks_mask(
    tracks: Iterable[ObjectTrack],
    camera: Camera,
    T_world_camera: Float,
    t_us: int,
    *,
    margin: float = 0.0,
) -> NDArray[np.bool_]:
    """[H, W] bool, pixels with their centre inside the outline of any box.

    Occlusion by other objects is ignored.

    Args:
        tracks: tracks with the boxes.
        camera: gives size and K.
        T_world_camera: [4, 4], OpenCV camera frame.
        t_us: time [us]; a track just outside its time span counts, see
            ``ObjectTrack.transform_near``.
        margin: enlarges boxes on every side [m].
    """
    poses = [(track.transform_near(t_us), track.size) for track in tracks]
    boxes = [box_corners(T, np.add(size, 2 * margin)) for T, size in poses if T is not None]
    return _boxes_mask(boxes, camera, T_world_camera)


def objects_mask(
    scene: Scene, camera: Camera, t_us: int, *, only: Collection[str] | None = None
) -> NDArray[np.bool_]:
    """:func:`tracks_mask` of the objects of a scene, seen from its recording vehicle.

    Args:
        only: ids of the objects to include; all by default.
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
    """Convex hull [P, 2] of a box on the image [px]; empty behind the camera.

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
    """Set the pixels of ``mask`` [H, W] with their centre in the convex ``outline`` [P, 2] [px]."""
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


# Sky masks and static surfaces.
#
# The search starts in image columns in which the uppermost LiDAR beams got no return. In each of
# them the sky ends at the first strong edge. The edge threshold minimises the variance of the
# colours above and below the border (Shen and Wang 2013). From there the sky grows into other
# columns, over similar colours and up to the next edge. Patches of the same colours elsewhere in
# the open columns, for example between a bridge and the trees behind it, also count as sky. Smooth
# walls that continue above the uppermost beam do not.

WIDTH = 640
"""Maximum width at which images are masked [px]."""
BOX_MARGIN = 0.3
"""Margin around the boxes of objects without sky [m]."""
UPPERMOST = math.radians(1.5)
"""Maximum angle below the highest return of returns from the uppermost beams."""
FAR = 10.0
"""Minimum distance of the returns that determine the highest elevation [m]."""
OPEN_MARGIN = 3
"""Number of columns on each side of a high return that are also blocked."""
GRADIENTS = np.linspace(5.0, 300.0, 40)
"""Candidates for the minimum gradient of the border (Sobel, of grey from 0 to 255)."""
SKY_WEIGHT = 2.0
"""Weight of the variance of the sky's colours against the variance of the rest."""
GROWING_GRADIENT = 40.0
"""Maximum gradient across which the sky grows beyond open columns."""
MIN_SHARE = 0.005
"""Minimum fraction of the open columns for the sky, and for the rest."""
MIN_PATCH = 0.0005
"""Minimum area of a sky patch separate from the sky at the top, as a fraction of the image."""
ALIKE = 3.0
"""Maximum distance of sky colours from the mean, in standard deviations."""
MIN_DEVIATION = 4.0
"""Minimum standard deviation of the sky's colours, 0 to 255, for overexposed skies."""
TRIMMINGS = 3
"""Rounds of dropping outliers, such as a tree at the top."""
BRIGHTER = 1.2
"""Minimum ratio of the brightness of the sky to the rest of the image."""
HORIZON = math.radians(1.0)
"""Margin of the horizon for pitch and roll of the vehicle [rad]."""
CLEAR = 2
"""Radius around LiDAR returns without sky [px]."""


def sky_mask(
    log: DrivingLog,
    camera: Camera,
    frame: int,
    image: NDArray[np.uint8],
    *,
    sweep: LidarSweep | None = None,
) -> NDArray[np.bool_]:
    """Sky pixels [H, W] of an image of a log; none without LiDAR.

    Args:
        log: log with poses.
        camera: camera of ``log``, at the size of ``image``.
        frame: frame of ``log``.
        image: [H, W, 3] RGB.
        sweep: sweep of ``frame``; None reads it.

    Raises:
        LogError: the sweep cannot be read.
    """
    import cv2

    small = camera.resized(min(WIDTH, camera.width))
    sweep = log.lidar(frame) if sweep is None else sweep
    t_us = image_time(log, camera.name, frame)
    pixels, inside = _pixels(small, points_in_camera(log, small, frame, t_us, sweep=sweep))
    pose = small.pose(log.ego.transform(t_us))
    blocked = _hit(small, pixels) | ~(_rise(small, pose) > 0)
    blocked |= ~_outside_of_boxes(log, small, frame)
    is_open = _open_columns(small, pixels, _is_high(sweep)[inside])
    mask = sky_of_image(resized(image, small), blocked, is_open).astype(np.uint8)
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0)


def still_surfaces(
    log: DrivingLog, camera: Camera, frame: int, image: NDArray[np.uint8]
) -> NDArray[np.bool_]:
    """Pixels [H, W] outside the sky and outside all boxes; see :func:`sky_mask`."""
    sky = sky_mask(log, camera, frame, image)
    return np.asarray(_outside_of_boxes(log, camera, frame) & ~sky)


def sky_of_image(
    image: NDArray[np.uint8], blocked: NDArray[np.bool_], is_open: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Sky pixels [H, W] of an image.

    Args:
        image: [H, W, 3] RGB.
        blocked: [H, W] pixels that do not show the sky.
        is_open: [W] columns in which the search starts.
    """
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    ends = np.stack([_first_row((gradient > least) | blocked) for least in GRADIENTS])
    none = np.zeros(grey.shape, np.bool_)
    if not is_open.any():
        return none
    merit = _merits(image[:, is_open], ends[:, is_open])
    best = int(merit.argmax())
    sky = (np.arange(len(grey))[:, None] < ends[best]) & is_open
    if merit[best] == 0 or grey[sky].mean() < BRIGHTER * grey[~sky & is_open].mean():
        return none
    least = float(GRADIENTS[best])
    alike = ~blocked & _like_most(image, image[sky])
    sky &= alike
    labels, _ = _connected(sky | (alike & (gradient <= min(least, GROWING_GRADIENT))))
    grown = np.isin(labels, labels[sky])
    labels, areas = _connected(alike & is_open & (gradient <= least))
    patches = (labels > 0) & (areas > MIN_PATCH * sky.size)[labels]
    return np.asarray(grown | patches)


def _outside_of_boxes(log: DrivingLog, camera: Camera, frame: int) -> NDArray[np.bool_]:
    """[H, W] pixels outside of the outlines of all boxes."""
    t_us = image_time(log, camera.name, frame)
    pose = camera.pose(log.ego.transform(t_us))
    return ~tracks_mask(log.tracks, camera, pose, t_us, margin=BOX_MARGIN)


def below_horizon(log: DrivingLog, camera: Camera, frame: int) -> NDArray[np.bool_]:
    """Pixels [H, W] more than HORIZON below the horizon, which cannot show the sky."""
    pose = camera.pose(log.ego.transform(image_time(log, camera.name, frame)))
    return np.asarray(_rise(camera, pose) < -math.sin(HORIZON))


def _rise(camera: Camera, pose: Float) -> Float:
    """Sine [H, W] of the elevation of the pixels' rays; nan for pixels without a ray."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays, valid = camera.unproject(np.stack([u, v], -1))
    return np.where(valid, rays @ pose[2, :3] / np.linalg.norm(rays, axis=-1), np.nan)


def _pixels(camera: Camera, points: Float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Column and row [M, 2] of the points [N, 3] in the camera frame that are in front of it and
    within the columns of the image; and a mask [N] of these points.
    """
    pixels, valid = camera.project(points)
    inside = valid & (points[:, 2] > 0) & (np.abs(pixels) < 1e6).all(1)
    inside &= (pixels[:, 0] >= 0) & (pixels[:, 0] < camera.width)
    return np.floor(pixels[inside]).astype(np.int64), inside


def _hit(camera: Camera, pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[H, W] bool, pixels near those of the returns [M, 2]."""
    import cv2

    u, v = pixels[(pixels[:, 1] >= 0) & (pixels[:, 1] < camera.height)].T
    hit = np.zeros((camera.height, camera.width), np.uint8)
    hit[v, u] = 1
    return np.asarray(cv2.dilate(hit, np.ones((2 * CLEAR + 1,) * 2, np.uint8)) > 0)


def _is_high(sweep: LidarSweep) -> NDArray[np.bool_]:
    """Mask [N] of the returns of a sweep from its uppermost beams."""
    x, y, z = (sweep.points - sweep.origin).astype(np.float64).T
    distance = np.hypot(x, y)
    elevation = np.arctan2(z, distance)
    # The lasers of a sensor are centimetres apart, which distorts the elevation of near returns.
    far = elevation[distance > FAR]
    top = float(np.quantile(far, 0.999)) if len(far) else math.pi
    return np.asarray(elevation > top - UPPERMOST)


def _open_columns(
    camera: Camera, pixels: NDArray[np.int64], high: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Columns [W] of an image with LiDAR returns, but none from the uppermost beams."""
    import cv2

    hits = np.zeros((2, camera.width), np.uint8)
    hits[0, pixels[:, 0]] = 1
    hits[1, pixels[high, 0]] = 1
    kernel = np.ones((1, 2 * OPEN_MARGIN + 1), np.uint8)
    any_hit, high_hit = cv2.dilate(hits, kernel) > 0
    return np.asarray(any_hit & ~high_hit)


def _first_row(ends: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Row [W] of the first set pixel in each column of [H, W]; H for none."""
    return np.where(ends.any(0), ends.argmax(0), len(ends))


def _merits(image: NDArray[np.uint8], ends: NDArray[np.int64]) -> Float:
    """Quality of borders [T, W]: 1 over the variances of the colours above and below; 0 if one of
    the sides has almost no pixels.
    """
    colours = image.astype(np.float64)
    products = colours[..., :, None] * colours[..., None, :]
    height, width = image.shape[:2]
    first = np.concatenate([np.ones((height, width, 1)), colours], -1)
    values = np.concatenate([first, products.reshape(height, width, 9)], -1)
    down = np.concatenate([np.zeros((1, width, 13)), values.cumsum(0)])
    above = down[ends, np.arange(width)].sum(1)
    share = above[:, 0] / (height * width)
    merit = 1 / (SKY_WEIGHT * _spreads(above) + _spreads(down[-1].sum(0) - above) + 1e-9)
    return np.where((share > MIN_SHARE) & (share < 1 - MIN_SHARE), merit, 0.0)


def _spreads(sums: Float) -> Float:
    """Determinant plus largest eigenvalue of covariances, from sums [T, 13] over pixels."""
    count = np.maximum(sums[:, :1], 1.0)
    mean = sums[:, 1:4] / count
    covariance = (sums[:, 4:] / count).reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    largest = np.linalg.eigvalsh(covariance)[:, -1]
    return np.asarray(np.abs(np.linalg.det(covariance)) + largest)


def _like_most(image: NDArray[np.uint8], colours: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels [H, W] of an image with colours like most of ``colours`` [N, 3]."""
    given, values = colours.astype(np.float64), image.astype(np.float64)
    for _ in range(TRIMMINGS):
        given = given[_near(given, given)]
    return _near(values, given)


def _near(values: Float, colours: Float) -> NDArray[np.bool_]:
    """Mask [...] of ``values`` [..., 3] within a few standard deviations of ``colours`` [N, 3]."""
    spread = np.cov(colours.T, bias=True) + MIN_DEVIATION**2 * np.eye(3)
    off = values - colours.mean(0)
    return np.asarray(((off @ np.linalg.inv(spread)) * off).sum(-1) < ALIKE**2)


def _connected(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Labels [H, W] of the connected parts of a mask, 0 outside, and the areas of all labels."""
    import cv2

    found = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return np.asarray(found[1], np.int32), np.asarray(found[2][:, cv2.CC_STAT_AREA], np.int32)


__all__ = ["below_horizon", "sky_mask", "sky_of_image", "still_surfaces"]
