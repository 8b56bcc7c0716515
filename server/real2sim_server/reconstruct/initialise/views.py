"""Visibility and colours of Gaussians in the logged camera views, and the sky as a cube map."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry import Float
from ...logs import DrivingLog
from ...scene import Camera, Sky
from ...scene.scene import face_directions
from ..logged_view import spread
from . import view_kernels as kernels
from .surfels import Surfels

# Camera views: colours of Gaussians, and uncovered pixels.

DEPTH_DOWNSCALE = 2
"""The depth image is this much smaller than the camera image."""
PYRAMID = 4
OBJECT_MARGIN = 0.12
"""Margin by which objects are enlarged to occlude the scene behind them [m]."""
MAX_REACH = 15
"""Upper bound of this margin [px of the depth image]."""

_NearestObjects = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class PlacedSurfels:
    """All Gaussians of a scene under construction.

    Attributes:
        surfels: surfels in the frames of their instances.
        instance: [N] uint16, 0 for the background, else 1 + index of the track; increasing.
    """

    surfels: Surfels
    instance: NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class ProjectedView:
    """One camera at one frame.

    Attributes:
        camera: the camera.
        frame: index of the frame.
        T_camera_world: [4, 4].
        image: [H, W, 3] uint8.
        depth: [H / 2, W / 2] float32 [m], nearest Gaussian, inf for none.
        on_object: [H / 2, W / 2] bool, pixels on a tracked object or next to one.
    """

    camera: Camera
    frame: int
    T_camera_world: Float
    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    on_object: NDArray[np.bool_]


def chosen_frames(log: DrivingLog, limit: int) -> list[int]:
    """At most ``limit`` frames with images, evenly spread, including the first and the last."""
    return spread(log.seen_frames(), limit)


class ColourSamples:
    """Gathers the best views of each Gaussian."""

    def __init__(self, placed: PlacedSurfels, slots: int) -> None:
        n = len(placed.surfels)
        self._placed = placed
        self._means = np.ascontiguousarray(placed.surfels.points, dtype=np.float32)
        self._normals = np.ascontiguousarray(placed.surfels.normals, dtype=np.float32)
        tangents = placed.surfels.scales[:, :2]
        self._radii = (1.4 * tangents.max(axis=1)).astype(np.float32)
        self._footprints = np.sqrt(tangents[:, 0] * tangents[:, 1]).astype(np.float32)
        self._cores = os.cpu_count() or 1
        self._parts = self._split_by_instance()
        self._in_camera = np.zeros((n, 3), dtype=np.float32)
        self._turned = np.zeros((n, 3), dtype=np.float32)
        self._colours = np.zeros((n, slots, 3), dtype=np.uint8)
        self._weights = np.zeros((n, slots), dtype=np.float32)

    def add(
        self, log: DrivingLog, camera: Camera, frame: int, image: NDArray[np.uint8]
    ) -> ProjectedView:
        """Project all Gaussians into ``camera`` at ``frame`` and sample their colours."""
        t_us = log.image_time_us(camera.name, frame)
        T_camera_world = camera.viewmat(log.ego.transform(t_us))
        poses = _instance_poses(log, t_us)
        transforms = np.stack(
            [np.eye(4) if pose is None else T_camera_world @ pose for pose in poses]
        )
        present = np.array([pose is not None for pose in poses])
        self._project(transforms, present)
        k = np.array([camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]], np.float32)
        shape = (-(-camera.height // DEPTH_DOWNSCALE), -(-camera.width // DEPTH_DOWNSCALE))
        depth, objects = self._depths(k / np.float32(DEPTH_DOWNSCALE), shape)
        nearest = nearest_objects(objects, float(k[0]) / DEPTH_DOWNSCALE, shape)
        self._gather(k, depth, nearest, _pyramid(image))
        return ProjectedView(camera, frame, T_camera_world, image, depth, np.isfinite(nearest[0]))

    def mean(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Colours [N, 3] float32 in [0, 1], and a mask [N] of the known ones; the others are 0."""
        n = len(self._means)
        colours, known = np.zeros((n, 3), dtype=np.float32), np.zeros(n, dtype=np.bool_)
        kernels.robust_mean(self._colours, self._weights, colours, known)
        return colours, known

    def deviation(self) -> NDArray[np.float32]:
        """Standard deviation [N] of the brightness of each Gaussian's samples, 0 to 255."""
        used = self._weights > 0
        count = np.maximum(used.sum(axis=1), 1)
        brightness = self._colours.mean(axis=2, dtype=np.float32) * used
        mean = brightness.sum(axis=1) / count
        variance = (brightness**2).sum(axis=1) / count - mean**2
        return np.asarray(np.sqrt(np.maximum(variance, 0)), dtype=np.float32)

    def _project(self, transforms: Float, present: NDArray[np.bool_]) -> None:
        matrices = np.ascontiguousarray(transforms[:, :3], dtype=np.float32)

        def work(part: slice) -> None:
            kernels.to_camera(
                self._means[part],
                self._normals[part],
                self._placed.instance[part],
                matrices,
                present,
                self._in_camera[part],
                self._turned[part],
            )

        self._on_all_cores(work)

    def _depths(
        self, k: NDArray[np.float32], shape: tuple[int, int]
    ) -> tuple[NDArray[np.float32], dict[int, NDArray[np.float32]]]:
        """Depth image of everything, and one of each object in view."""

        def work(part: slice) -> NDArray[np.float32]:
            depth = np.full(shape, np.inf, dtype=np.float32)
            kernels.splat_depth(
                self._in_camera[part], self._turned[part], self._radii[part], k, depth
            )
            return depth

        with ThreadPoolExecutor(self._cores) as pool:
            images = list(pool.map(work, [part for _, part in self._parts]))
        objects = {
            instance: image
            for (instance, _), image in zip(self._parts, images, strict=True)
            if instance > 0 and np.isfinite(image).any()
        }
        return np.asarray(np.minimum.reduce(images)), objects

    def _gather(
        self,
        k: NDArray[np.float32],
        depth: NDArray[np.float32],
        nearest: _NearestObjects,
        pyramid: tuple[NDArray[np.uint8], ...],
    ) -> None:
        def work(part: slice) -> None:
            kernels.gather_samples(
                self._in_camera[part],
                self._turned[part],
                self._footprints[part],
                self._placed.instance[part],
                k,
                DEPTH_DOWNSCALE,
                depth,
                *nearest,
                pyramid,
                self._colours[part],
                self._weights[part],
            )

        self._on_all_cores(work)

    def _on_all_cores(self, work: Callable[[slice], None]) -> None:
        """Run ``work`` on all Gaussians, split into ranges."""
        with ThreadPoolExecutor(self._cores) as pool:
            list(pool.map(work, _ranges(0, len(self._means), self._cores)))

    def _split_by_instance(self) -> list[tuple[int, slice]]:
        """Ranges of Gaussians, one per object, and one per core for the background."""
        bounds = np.flatnonzero(np.diff(self._placed.instance)) + 1
        edges = [0, *bounds.tolist(), len(self._means)]
        parts: list[tuple[int, slice]] = []
        for start, stop in pairwise(edges):
            instance = int(self._placed.instance[start])
            count = self._cores if instance == 0 else 1
            parts += [(instance, part) for part in _ranges(start, stop, count)]
        return parts


def _ranges(start: int, stop: int, count: int) -> list[slice]:
    bounds = [start + (stop - start) * i // count for i in range(count + 1)]
    return [slice(a, b) for a, b in pairwise(bounds)]


def gather_views(
    log: DrivingLog,
    placed: PlacedSurfels,
    *,
    frames: list[int],
    slots: int,
    on_view: Callable[[ProjectedView], None],
) -> ColourSamples:
    """Sample the colours of all Gaussians from all cameras at ``frames``, with occlusion.

    A Gaussian is visible in a view if no surface is in front of it in the depth image of all
    Gaussians, and no other object, rendered slightly enlarged. Of the ``slots`` nearest, most
    frontal views, those that agree with their median are averaged.

    Args:
        on_view: called after each view.
    """
    samples = ColourSamples(placed, slots)
    for camera, frame, image in _images(log, frames):
        on_view(samples.add(log, camera, frame, image))
    return samples


def _images(log: DrivingLog, frames: list[int]) -> Iterator[tuple[Camera, int, NDArray[np.uint8]]]:
    """All images in order, prefetched by one."""
    wanted = [(c, frame) for frame in frames for c in log.rig if log.has_image(c.name, frame)]
    with ThreadPoolExecutor(1) as reader:
        ahead = [reader.submit(log.image, c.name, f) for c, f in wanted[:1]]
        for index, (camera, frame) in enumerate(wanted):
            image = ahead.pop().result()
            ahead += [reader.submit(log.image, c.name, f) for c, f in wanted[index + 1 : index + 2]]
            yield camera, frame, image


def _instance_poses(log: DrivingLog, t_us: int) -> list[Float | None]:
    """``T_world_instance`` of the background, then of the tracks; None for absent tracks."""
    return [np.eye(4), *(track.transform_near(t_us) for track in log.tracks)]


def nearest_objects(
    objects: dict[int, NDArray[np.float32]], focal: float, shape: tuple[int, int]
) -> _NearestObjects:
    """Depth of the nearest object in each pixel, its instance, and depth of the second nearest.

    Objects are enlarged by OBJECT_MARGIN, because boxes and poses are inexact.
    """
    import cv2

    first = np.full(shape, np.inf, dtype=np.float32)
    second = first.copy()
    first_object = np.full(shape, -1, dtype=np.int32)
    for instance, depth in objects.items():
        distance = float(np.quantile(depth[np.isfinite(depth)], 0.3))
        reach = min(max(1, round(OBJECT_MARGIN * focal / distance)), MAX_REACH)
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        # The default border is the largest finite number, not infinity.
        enlarged = cv2.erode(depth, disk, borderType=cv2.BORDER_REPLICATE)
        nearer = enlarged < first
        second = np.where(nearer, first, np.minimum(second, enlarged))
        first_object[nearer] = instance
        first = np.minimum(first, enlarged)
    return first, first_object, second


def _pyramid(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], ...]:
    import cv2

    levels = [np.ascontiguousarray(image)]
    while len(levels) < PYRAMID:
        height, width = levels[-1].shape[:2]
        size = (max(1, width // 2), max(1, height // 2))
        smaller = cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, dtype=np.uint8))
    return tuple(levels)


# The sky, and everything beyond the LiDAR's range, as a cube map.

Coordinates = NDArray[np.floating[Any]]

SLOTS = 15
"""Number of samples per direction for the median."""
PANORAMA = (256, 512)
ZENITH = np.array([0.75, 0.82, 0.9])
"""Colour of a sky that no camera observed."""
FADE = 1 / 24
"""Fraction of a full turn over which the weight of an observed colour falls to 1/e."""
GROUND_ELEVATION = -0.03
"""Elevation below which directions get the colour of the ground [rad]."""


class SkySamples:
    """Collects sky pixels by direction, or pixels without a Gaussian if no sky was seen there."""

    def __init__(self, resolution: int) -> None:
        self._resolution = resolution
        self._directions = face_directions(resolution).reshape(-1, 3)
        n = len(self._directions)
        self._slots: list[NDArray[np.uint8]] = []
        self._counts = np.zeros(n, dtype=np.uint8)
        self._is_sky = np.zeros(n, dtype=np.bool_)

    def add(self, view: ProjectedView, sky: NDArray[np.bool_]) -> None:
        """Add sky pixels, and pixels that show neither a Gaussian nor a tracked object.

        Args:
            sky: [H, W] bool, sky pixels of ``view``. A direction with a sky pixel in any view keeps
                only sky pixels.
        """
        texels, u, v = self._texels_in(view)
        row, column = (v / DEPTH_DOWNSCALE).astype(np.int64), (u / DEPTH_DOWNSCALE).astype(np.int64)
        shows_sky = sky[v.astype(np.int64), u.astype(np.int64)]
        found = texels[shows_sky & ~self._is_sky[texels]]
        self._is_sky[found] = True
        self._counts[found] = 0
        for values in self._slots:
            values[found] = 255
        free = np.where(self._is_sky[texels], shows_sky, uncovered_pixels(view)[row, column])
        free &= self._counts[texels] < SLOTS
        texels, u, v = texels[free], u[free], v[free]
        colours = _bilinear(view.image, u, v)
        slot = self._counts[texels]
        while len(self._slots) <= int(slot.max(initial=0)):
            self._slots.append(np.full((len(self._directions), 3), 255, dtype=np.uint8))
        for s in range(int(slot.max(initial=0)) + 1):
            mine = slot == s
            self._slots[s][texels[mine]] = colours[mine]
        self._counts[texels] += 1

    def _texels_in(self, view: ProjectedView) -> tuple[NDArray[np.int64], Coordinates, Coordinates]:
        """Texels inside the image and their pixel coordinates u, v."""
        camera = view.camera
        rotation = view.T_camera_world[:3, :3].astype(np.float32)
        ahead = np.flatnonzero(self._directions @ rotation[2] > 0.05)
        x, y, z = (self._directions[ahead] @ rotation.T).T
        u = camera.K[0, 0] * x / z + camera.K[0, 2]
        v = camera.K[1, 1] * y / z + camera.K[1, 2]
        inside = (u >= 1) & (v >= 1) & (u < camera.width - 1) & (v < camera.height - 1)
        return ahead[inside], u[inside], v[inside]

    def finish(self, ground_colour: NDArray[np.float32]) -> Sky:
        """The cube map: medians of the observed directions, elsewhere the nearest sky colours.

        Trees and walls without a Gaussian are not continued, unless no view shows sky.
        """
        known = self._counts > 0
        texels = np.zeros((len(self._directions), 3), dtype=np.float32)
        texels[known] = self._median(known)
        continued = self._is_sky if self._is_sky.any() else known
        fill = _panorama(self._directions, texels, continued, ground_colour)
        texels[~known] = _look_up(fill, self._directions[~known])
        r = self._resolution
        return Sky(torch.from_numpy(texels.reshape(6, r, r, 3).clip(0, 1)))

    def _median(self, known: NDArray[np.bool_]) -> NDArray[np.float32]:
        stack = np.stack([slot[known] for slot in self._slots])
        # Unused slots hold 255 and so stay behind the used ones.
        stack.sort(axis=0)
        middle = (self._counts[known].astype(np.int64) - 1) // 2
        chosen = np.take_along_axis(stack, middle[None, :, None], axis=0)[0]
        return np.asarray(chosen.astype(np.float32) / 255)


def uncovered_pixels(view: ProjectedView) -> NDArray[np.bool_]:
    """[H / 2, W / 2] bool: pixels without a Gaussian or an object, small holes closed."""
    import cv2

    covered = (np.isfinite(view.depth) | view.on_object).astype(np.uint8)
    closed = cv2.morphologyEx(covered, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return np.asarray(closed == 0)


def _bilinear(image: NDArray[np.uint8], u: Coordinates, v: Coordinates) -> NDArray[np.uint8]:
    if len(u) == 0:
        return np.zeros((0, 3), dtype=np.uint8)
    return np.asarray(_remap(image, u - 0.5, v - 0.5), dtype=np.uint8)


def _remap(image: NDArray[Any], columns: Coordinates, rows: Coordinates) -> NDArray[Any]:
    """Bilinear values [N, 3] of an image [H, W, 3] at ``columns`` and ``rows`` [N]."""
    import cv2

    # OpenCV limits the width of a map, so long lists of positions take several rows.
    side = 1 << 14
    shape = -(-len(columns) // side), side
    maps = [np.zeros(shape, dtype=np.float32) for _ in range(2)]
    for given, values in zip(maps, (columns, rows), strict=True):
        given.reshape(-1)[: len(values)] = values
    flat = np.asarray(cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR))
    return flat.reshape(-1, 3)[: len(columns)]


def _panorama(
    directions: NDArray[np.float32],
    texels: NDArray[np.float32],
    known: NDArray[np.bool_],
    ground_colour: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Elevation x azimuth image [H, W, 3] that extends the known texels all around."""
    height, width = PANORAMA
    row, column = _panorama_place(directions[known])
    flat = row.astype(np.int64) * width + column.astype(np.int64)
    counts = np.bincount(flat, minlength=height * width).reshape(height, width)
    sums = np.stack([np.bincount(flat, texels[known, c], height * width) for c in range(3)], -1)
    values = sums.reshape(height, width, 3) / np.maximum(counts, 1)[..., None]
    elevation = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    seen = np.flatnonzero((counts > 0).any(axis=1) & (elevation > 0))
    panorama = np.empty((height, width, 3))
    for r in range(height):
        if elevation[r] < GROUND_ELEVATION or len(seen) == 0:
            panorama[r] = ground_colour if elevation[r] < 0 else ZENITH
        else:
            # Directions never observed take the colours observed at the same elevation.
            nearest = int(seen[np.abs(seen - r).argmin()])
            panorama[r] = _around(values[nearest], counts[nearest] > 0)
    return _softened(panorama)


def _around(row: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """A closed ring of colours [W, 3], fading from the nearest known ones to their mean."""
    width = len(row)
    place = np.flatnonzero(known)
    gap = np.abs(np.arange(width)[:, None] - place)
    gap = np.minimum(gap, width - gap)
    trust = np.exp(-gap.min(axis=1) / (FADE * width))[:, None]
    nearest = row[place[gap.argmin(axis=1)]]
    return np.asarray(trust * nearest + (1 - trust) * row[place].mean(axis=0))


def _softened(panorama: NDArray[np.float64]) -> NDArray[np.float32]:
    import cv2

    width = panorama.shape[1]
    # Three copies side by side avoid a seam at the back.
    blurred = cv2.GaussianBlur(np.tile(panorama, (1, 3, 1)).astype(np.float32), (0, 0), 2)
    return np.asarray(blurred, dtype=np.float32)[:, width : 2 * width]


def _panorama_place(directions: NDArray[np.float32]) -> tuple[Coordinates, Coordinates]:
    height, width = PANORAMA
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    row = np.clip((np.pi / 2 - elevation) / np.pi * height, 0, height - 1e-3)
    return row, np.clip((azimuth + np.pi) / (2 * np.pi) * width, 0, width - 1e-3)


def _look_up(panorama: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.float32]:
    row, column = _panorama_place(directions)
    wrapped = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    values = _remap(wrapped, column + 0.5, np.maximum(row - 0.5, 0))
    return np.asarray(values, dtype=np.float32)
