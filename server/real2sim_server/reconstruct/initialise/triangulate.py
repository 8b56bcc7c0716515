"""Points from the images alone: features matched between known poses, and dense stereo."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...logs import DrivingLog
from ...scene import Camera
from ..logged_view import resized, spread, still_surfaces

# Triangulation of features matched between known poses.

MAX_WIDTH = 1280
"""Images are downscaled to this width [px]."""
FEATURES = 4000
"""Maximum number of features per image. The strongest are kept."""
BASELINES = (0.5, 1.5, 4.0)
"""Each image is matched with the next one, and with the first one beyond each baseline [m]."""
MIN_STEP = 0.2
"""Minimum distance between consecutive images of a camera [m]."""
MIN_DEPTH, MAX_DEPTH = 1.0, 400.0
EPIPOLAR_ERROR = 1.5
"""Maximum distance of a match from its epipolar line, and maximum reprojection error [px]."""
RATIO = 0.8
"""Ratio test: maximum distance of a match relative to the next best one (Lowe 2004)."""
SIGHTINGS = 3
"""Minimum number of images that show a point."""
RELATIVE_ERROR = 0.2
"""Maximum standard deviation of a point, as a fraction of its distance."""

_Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class TriangulatedPoints:
    """Points that several images agree on.

    Attributes:
        points: [N, 3] float32, world frame [m].
        deviation: [N] float32, largest standard deviation for image errors of half a pixel [m].
        sightings: [N] int32, number of images that show each point.
    """

    points: NDArray[np.float32]
    deviation: NDArray[np.float32]
    sightings: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: NDArray[np.bool_]) -> TriangulatedPoints:
        """The points selected by a mask."""
        return TriangulatedPoints(self.points[index], self.deviation[index], self.sightings[index])


@dataclass(frozen=True, eq=False)
class _Features:
    """Features of one image.

    Attributes:
        projection: [3, 4], ``K [R | t]`` of the image, to pixels of the scaled one.
        centre: [3] of the camera, world.
        pixels: [N, 2] float64.
        descriptors: [N, 128] float32 of unit length.
    """

    projection: Float
    centre: Float
    pixels: Float
    descriptors: NDArray[np.float32]


def triangulate(log: DrivingLog, *, max_images: int, on_image: _Progress) -> TriangulatedPoints:
    """Points of the static scene, from features shared by at least three images.

    SIFT features (Lowe 2004) outside all boxes and the sky are matched along the epipolar lines of
    the known poses, between images of one camera taken decimetres to metres apart. Matches are
    joined to tracks. A track becomes a point if its reprojection error is at most 1.5 px in all
    images and its standard deviation is at most 20 % of its distance. The result is deterministic,
    bit for bit.

    Args:
        log: log with calibrated cameras and poses.
        max_images: maximum number per camera, evenly spread.
        on_image: called with the number of finished images and of all images.
    """
    sightings: list[tuple[Float, Float, Float]] = []
    labels: list[NDArray[np.int64]] = []
    first_label, done = 0, 0
    chosen = {camera.name: spread_frames(log, camera, max_images) for camera in log.rig}
    total = sum(len(frames) for frames in chosen.values())
    for camera in log.rig:
        images = []
        for frame in chosen[camera.name]:
            images.append(_features(log, camera, frame))
            done += 1
            on_image(done, total)
        tracks = _tracks(images)
        labels += [track + first_label for track in tracks]
        first_label += int(max((t.max(initial=-1) for t in tracks), default=-1)) + 1
        sightings += [(i.projection, i.centre, i.pixels) for i in images]
    return _points(sightings, labels)


def spread_frames(log: DrivingLog, camera: Camera, limit: int) -> list[int]:
    """Up to ``limit`` frames with camera motion between them."""
    kept: list[int] = []
    last: Float | None = None
    if limit == 0:
        return []
    for frame in range(log.frame_count):
        if not log.has_image(camera.name, frame):
            continue
        centre = _pose(log, camera, frame)[:3, 3]
        if last is None or np.linalg.norm(centre - last) >= MIN_STEP:
            kept.append(frame)
            last = centre
    return spread(kept, limit)


def _pose(log: DrivingLog, camera: Camera, frame: int) -> Float:
    return camera.pose(log.ego.transform(log.image_time_us(camera.name, frame)))


def _features(log: DrivingLog, camera: Camera, frame: int) -> _Features:
    import cv2

    small = camera.resized(min(MAX_WIDTH, camera.width))
    image = resized(log.image(camera.name, frame), small)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    free = still_surfaces(log, small, frame, image)
    pose = _pose(log, camera, frame)
    viewmat = invert_transform(pose)
    detector = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=0.005, edgeThreshold=20)
    keypoints, found = detector.detectAndCompute(grey, free.astype(np.uint8))
    pixels = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2) + 0.5
    descriptors = np.zeros((0, 128), np.float32) if found is None else found.astype(np.float32)
    # The dot product of square-rooted histograms is Hellinger's kernel (Arandjelovic, Zisserman
    # 2012).
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return _Features(small.K @ viewmat[:3], pose[:3, 3].copy(), pixels, descriptors)


def _tracks(images: list[_Features]) -> list[NDArray[np.int64]]:
    """For each image, the track [N] of each feature, -1 for none."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    starts = np.concatenate([[0], np.cumsum([len(i.pixels) for i in images])]).astype(np.int64)
    pairs = [
        np.stack([starts[a] + first, starts[b] + second])
        for a, b in _pairs(images)
        for first, second in [_matches(images[a], images[b])]
    ]
    joined = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), np.int64)
    size = int(starts[-1])
    graph = coo_array((np.ones(joined.shape[1], np.int8), tuple(joined)), shape=(size, size))
    _, labels = connected_components(graph, directed=False)
    counts = np.bincount(labels, minlength=1)
    labels = np.where(counts[labels] >= SIGHTINGS, labels, -1).astype(np.int64)
    return [labels[a:b] for a, b in pairwise(starts)]


def _pairs(images: list[_Features]) -> Iterator[tuple[int, int]]:
    """Pairs of images to match: each with the next, and with the first beyond each baseline."""
    centres = np.array([i.centre for i in images]).reshape(-1, 3)
    for a in range(len(images) - 1):
        distance = np.linalg.norm(centres[a + 1 :] - centres[a], axis=1)
        later = {int(np.argmax(distance >= b)) for b in BASELINES if (distance >= b).any()}
        yield from ((a, a + 1 + k) for k in sorted(later | {0}))


def _matches(first: _Features, second: _Features) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of features that are mutual best epipolar matches and pass the ratio test."""
    none = np.zeros(0, np.int64)
    if min(len(first.pixels), len(second.pixels)) < 2:
        return none, none
    likeness = first.descriptors @ second.descriptors.T
    likeness[_epipolar_distance(first, second) > EPIPOLAR_ERROR] = -1
    best = likeness.argmax(1)
    rows = np.arange(len(best))
    top = likeness[rows, best]
    likeness[rows, best] = -1
    next_best = likeness.max(1)
    likeness[rows, best] = top
    mutual = likeness.argmax(0)[best] == rows
    # Squared distances of unit vectors are 2 - 2 times their product.
    clear = (1 - top) < RATIO**2 * (1 - next_best)
    kept = np.flatnonzero((top > 0.7) & mutual & clear)
    return kept, best[kept]


def _epipolar_distance(first: _Features, second: _Features) -> NDArray[np.float32]:
    """[N, M] distance of each feature of ``second`` from the line of each of ``first`` [px]."""
    F = _fundamental(first, second)
    lines = np.concatenate([first.pixels, np.ones((len(first.pixels), 1))], 1) @ F.T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    ends = np.concatenate([second.pixels, np.ones((len(second.pixels), 1))], 1)
    return np.abs(lines.astype(np.float32) @ ends.T.astype(np.float32))


def _fundamental(first: _Features, second: _Features) -> Float:
    """[3, 3] with ``x_second^T F x_first = 0`` (Hartley and Zisserman 2004, 9.2)."""
    inverse = np.linalg.pinv(first.projection)
    x, y, z = second.projection @ np.append(first.centre, 1.0)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(cross @ second.projection @ inverse)


def _points(
    sightings: list[tuple[Float, Float, Float]], labels: list[NDArray[np.int64]]
) -> TriangulatedPoints:
    """One point for each consistent track."""
    seen = [np.flatnonzero(label >= 0) for label in labels]
    if sum(map(len, seen)) == 0:
        none = np.zeros(0, np.float32)
        return TriangulatedPoints(none.reshape(0, 3), none, np.zeros(0, np.int32))
    track = np.concatenate([label[s] for label, s in zip(labels, seen, strict=True)])
    image = np.repeat(np.arange(len(seen)), [len(s) for s in seen])
    pixels = np.concatenate([p[s] for (_, _, p), s in zip(sightings, seen, strict=True)])
    projections = np.array([p for p, _, _ in sightings])
    centres = np.array([c for _, c, _ in sightings])
    _, track = np.unique(track, return_inverse=True)
    counts = np.bincount(track)
    # A track with two features of one image contains a wrong match.
    places = track * len(seen) + image
    single = np.bincount(track[np.unique(places, return_index=True)[1]], minlength=len(counts))
    points, precision, in_front, worst = _intersect(track, image, pixels, projections)
    distance = np.full(len(points), np.inf)
    np.minimum.at(distance, track, np.linalg.norm(points[track] - centres[image], axis=1))
    deviation = 0.5 / np.sqrt(np.maximum(np.linalg.eigvalsh(precision)[:, 0], 1e-12))
    kept = (
        (single == counts)
        & in_front
        & (worst <= EPIPOLAR_ERROR)
        & (distance >= MIN_DEPTH)
        & (distance <= MAX_DEPTH)
        & (deviation <= RELATIVE_ERROR * distance)
    )
    return TriangulatedPoints(
        points[kept].astype(np.float32),
        deviation[kept].astype(np.float32),
        counts[kept].astype(np.int32),
    )


def _intersect(
    track: NDArray[np.int64], image: NDArray[np.int64], pixels: Float, projections: Float
) -> tuple[Float, Float, NDArray[np.bool_], Float]:
    """Triangulate points and their precision.

    Returns:
        Points [T, 3] nearest to all their rays; their precision [T, 3, 3] per square pixel; whether
        they are in front of all cameras; and the largest reprojection error [T] [px].
    """
    count = int(track.max()) + 1
    P = projections[image]
    weight = np.ones(len(track))
    points: Float = np.zeros((count, 3))
    for _ in range(3):
        # u P_2 - P_0 and v P_2 - P_1, over the depth, are errors in pixels (ibid., 12.2).
        rows = (pixels[:, :, None] * P[:, 2:3] - P[:, :2]) * weight[:, None, None]
        normal = np.zeros((count, 3, 3))
        right = np.zeros((count, 3))
        np.add.at(normal, track, np.einsum("sai,saj->sij", rows[:, :, :3], rows[:, :, :3]))
        np.add.at(right, track, -np.einsum("sai,sa->si", rows[:, :, :3], rows[:, :, 3]))
        normal += 1e-12 * np.eye(3)
        points = np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], np.float64)
        seen = np.einsum("sij,sj->si", P[:, :, :3], points[track]) + P[:, :, 3]
        weight = 1 / np.maximum(np.abs(seen[:, 2]), 1e-3)
    error = np.linalg.norm(
        seen[:, :2] / np.where(seen[:, 2:] == 0, 1e-9, seen[:, 2:]) - pixels, axis=1
    )
    worst = np.zeros(count)
    np.maximum.at(worst, track, error)
    ahead = np.ones(count, dtype=np.bool_)
    np.logical_and.at(ahead, track, seen[:, 2] > 0)
    return points, normal, ahead, worst


# Dense stereo for regions without LiDAR returns: tree crowns, upper walls, roofs.
#
# A plane sweep through the view of each image (Collins 1996): the depth at which neighbouring
# images agree best is accepted if the depths of the neighbours are consistent with it.

WIDTH = 320
"""Width at which images are compared [px]. Depths are accurate to a few percent."""
STEREO_BASELINES = (0.8, 1.6)
"""Distances to the earlier and later images that each image is compared with [m]."""
PLANES = 96
NEAREST, FARTHEST = 4.0, 90.0
"""Depths of the planes, evenly spread by their inverse [m]."""
WINDOW = 5
"""Edge of the correlation window [px]."""
MIN_CONTRAST = 2.0
"""Minimum standard deviation of brightness in a window, 0 to 255; flatter windows are ambiguous."""
MIN_LIKENESS = 0.6
"""Minimum normalised cross-correlation of windows, mean of the two best neighbours."""
CLEARNESS, APART = 0.05, 3
"""Minimum lead in correlation of the best plane over all planes at least this many planes away."""
AGREEMENT = 0.03
"""Maximum relative difference between consistent depths of two images."""
AGREEING = 2
"""Minimum number of other images with a consistent depth."""
MARGIN = 0.03
"""Overlap with the region below the highest LiDAR returns, as a fraction of the image height."""


@dataclass(frozen=True, eq=False)
class _View:
    """One image and, once known, its depths.

    Attributes:
        grey: [H, W] float32, 0 to 255.
        free: [H, W] bool, outside of the sky and of the boxes of objects.
        K: [3, 3] at this size.
        pose: [4, 4] ``T_world_camera``.
        rows: number of compared rows, from the top.
    """

    grey: NDArray[np.float32]
    free: NDArray[np.bool_]
    K: Float
    pose: Float
    rows: int


def sweep_planes(log: DrivingLog, *, max_images: int, on_image: _Progress) -> NDArray[np.float32]:
    """Points [N, 3] float32 of the static scene above the LiDAR's field of view, world frame [m].

    Args:
        log: log with calibrated cameras and poses; only pinhole cameras are used.
        max_images: maximum number per camera, evenly spread.
        on_image: called with the number of finished images and of all images.
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
    """Number of rows from the top to the highest LiDAR returns."""
    to_camera = invert_transform(camera.T_vehicle_camera)
    x, y, z = apply_transform(to_camera, log.lidar(frame).points.astype(np.float64)).T
    ahead = z > 1
    u, v = (camera.K[i, i] * a[ahead] / z[ahead] + camera.K[i, 2] for i, a in ((0, x), (1, y)))
    hit = v[(u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)]
    highest = float(np.quantile(hit, 0.01)) if len(hit) else camera.height
    return max(WINDOW, min(camera.height, round(highest + MARGIN * camera.height)))


def _neighbours(view: _View, views: list[_View]) -> list[_View]:
    """The images nearest to each of STEREO_BASELINES, before and after."""
    offsets = np.array([v.pose[:3, 3] - view.pose[:3, 3] for v in views])
    distance = np.linalg.norm(offsets, axis=1)
    mine = next(k for k, v in enumerate(views) if v is view)
    later = np.arange(len(views)) > mine
    picked: list[int] = []
    for side in (later, ~later & (distance > 0)):
        for baseline in STEREO_BASELINES:
            near = np.flatnonzero(side & (distance > 0.5 * baseline) & (distance < 2 * baseline))
            if len(near):
                picked.append(int(near[np.abs(distance[near] - baseline).argmin()]))
    return [views[k] for k in sorted(set(picked))]


def _depths(view: _View, neighbours: list[_View]) -> NDArray[np.float32]:
    """Depths [rows, W] of an image [m], 0 where they are ambiguous."""
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
    clear = (top > MIN_LIKENESS) & (top - second > CLEARNESS) & (spread > MIN_CONTRAST)
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
    """Correlation [rows, W] of windows, assuming that ``view`` is at ``depth`` [m]; -1 outside the
    other image.
    """
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
    alike = product / np.maximum(spread * contrast, MIN_CONTRAST)
    return np.where(seen, alike, -1).astype(np.float32)


def _agreed(index: int, views: list[_View], depths: list[NDArray[np.float32]]) -> Float:
    """World points [N, 3] of an image with depths consistent with other images."""
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
    """Mask of the points [N, 3] that are consistent with the depths of an image."""
    local = apply_transform(invert_transform(view.pose), points)
    z = np.maximum(local[:, 2], 1e-3)
    pixels = (local @ view.K.T)[:, :2] / z[:, None]
    u, v = np.floor(pixels).astype(np.int64).T
    inside = (local[:, 2] > 1) & (u >= 0) & (u < depth.shape[1]) & (v >= 0) & (v < depth.shape[0])
    found = np.zeros(len(points), np.bool_)
    theirs = depth[v[inside], u[inside]]
    found[inside] = np.abs(theirs - z[inside]) < AGREEMENT * z[inside]
    return found
