"""What each logged camera view shows of the Gaussians: colours, and pixels that none covers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...logs import DrivingLog
from ...scene import Camera
from . import view_kernels as kernels
from .surfels import Surfels

DEPTH_DOWNSCALE = 2
"""The depth image is this much smaller than the camera image."""
PYRAMID = 4
OBJECT_MARGIN = 0.12
"""Objects hide what is behind them with this margin around them [m]."""
MAX_REACH = 15
"""Bound of that margin [px of the depth image]."""

_NearestObjects = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class PlacedSurfels:
    """All Gaussians of a scene in the making.

    Attributes:
        surfels: in the frame of their instance.
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
        depth: [H / 2, W / 2] float32 [m], nearest Gaussian, inf where there is none.
        on_object: [H / 2, W / 2] bool, pixels on a tracked object or next to one.
    """

    camera: Camera
    frame: int
    T_camera_world: Float
    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    on_object: NDArray[np.bool_]


def chosen_frames(log: DrivingLog, limit: int) -> list[int]:
    """At most ``limit`` frames, evenly spread, the first and the last among them."""
    count = min(limit, log.frame_count)
    return sorted({round(i) for i in np.linspace(0, log.frame_count - 1, count)})


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
        """Colours [N, 3] float32 in [0, 1], and which are known [N] bool; the others are 0."""
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
        """Run ``work`` on ranges of Gaussians that together are all of them."""
        with ThreadPoolExecutor(self._cores) as pool:
            list(pool.map(work, _ranges(0, len(self._means), self._cores)))

    def _split_by_instance(self) -> list[tuple[int, slice]]:
        """Ranges of Gaussians of one instance each; the background in one range per core."""
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
    """Sample the colours of all Gaussians from all cameras at ``frames``, occlusion respected.

    A view counts for a Gaussian when nothing lies before it in a depth image of all Gaussians,
    and no other object lies before it that is drawn somewhat larger than it is. Of the ``slots``
    nearest, most frontal views, those that agree with their median are averaged.

    Args:
        on_view: called with each view after it was sampled.
    """
    samples = ColourSamples(placed, slots)
    for camera, frame, image in _images(log, frames):
        on_view(samples.add(log, camera, frame, image))
    return samples


def _images(log: DrivingLog, frames: list[int]) -> Iterator[tuple[Camera, int, NDArray[np.uint8]]]:
    """All images in order, read one ahead."""
    wanted = [(camera, frame) for frame in frames for camera in log.rig]
    with ThreadPoolExecutor(1) as reader:
        ahead = [reader.submit(log.image, c.name, f) for c, f in wanted[:1]]
        for index, (camera, frame) in enumerate(wanted):
            image = ahead.pop().result()
            ahead += [reader.submit(log.image, c.name, f) for c, f in wanted[index + 1 : index + 2]]
            yield camera, frame, image


def _instance_poses(log: DrivingLog, t_us: int) -> list[Float | None]:
    """``T_world_instance``, first the background, then the tracks; None where there is none."""
    return [np.eye(4), *(track.transform_near(t_us) for track in log.tracks)]


def nearest_objects(
    objects: dict[int, NDArray[np.float32]], focal: float, shape: tuple[int, int]
) -> _NearestObjects:
    """Depth of the nearest object in each pixel, its instance, and depth of the second nearest.

    Objects are drawn larger by OBJECT_MARGIN, as boxes and poses are not exact.
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
