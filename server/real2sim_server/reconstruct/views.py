"""What each logged camera view shows of the Gaussians: colours, and pixels that none covers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..logs import DrivingLog
from ..scene import Camera
from ..scene.rotation import Float, invert_transform
from . import view_kernels as kernels
from .surfels import Surfels

SHRINK = 2
"""The depth image is this much smaller than the camera image."""
PYRAMID = 4
BOX_MARGIN = 0.15
"""Boxes hide what is behind them with this margin to the sides and the top [m]."""

_Result = TypeVar("_Result")
_BoxDepths = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class Placed:
    """All Gaussians of a scene in the making.

    Attributes:
        surfels: in the frame of their instance.
        instance: [N] uint16, 0 for the background, else 1 + index of the track.
    """

    surfels: Surfels
    instance: NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class View:
    """One camera at one frame.

    Attributes:
        camera: the camera.
        frame: index of the frame.
        T_camera_world: [4, 4].
        image: [H, W, 3] uint8.
        depth: [H / 2, W / 2] float32 [m], nearest Gaussian, inf where there is none.
        in_box: [H / 2, W / 2] bool, pixels whose ray passes through a tracked box.
    """

    camera: Camera
    frame: int
    T_camera_world: Float
    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    in_box: NDArray[np.bool_]


def chosen_frames(log: DrivingLog, limit: int) -> list[int]:
    """At most ``limit`` frames, evenly spread, the first and the last among them."""
    count = min(limit, log.frame_count)
    return sorted({round(i) for i in np.linspace(0, log.frame_count - 1, count)})


class ColourSamples:
    """Gathers the best views of each Gaussian."""

    def __init__(self, placed: Placed, slots: int) -> None:
        n = len(placed.surfels)
        self._placed = placed
        self._means = np.ascontiguousarray(placed.surfels.points, dtype=np.float32)
        self._normals = np.ascontiguousarray(placed.surfels.normals, dtype=np.float32)
        tangents = placed.surfels.scales[:, :2]
        self._radii = (1.4 * tangents.max(axis=1)).astype(np.float32)
        self._footprints = np.sqrt(tangents[:, 0] * tangents[:, 1]).astype(np.float32)
        self._in_camera = np.zeros((n, 3), dtype=np.float32)
        self._turned = np.zeros((n, 3), dtype=np.float32)
        self._colours = np.zeros((n, slots, 3), dtype=np.uint8)
        self._weights = np.zeros((n, slots), dtype=np.float32)

    def add(self, log: DrivingLog, camera: Camera, frame: int, image: NDArray[np.uint8]) -> View:
        """Look at all Gaussians from ``camera`` at ``frame``."""
        t_us = int(log.frame_times_us[frame])
        T_camera_world = camera.viewmat(log.ego.transform(t_us))
        poses = _instance_poses(log, t_us)
        transforms = np.stack(
            [np.eye(4) if pose is None else T_camera_world @ pose for pose in poses]
        )
        present = np.array([pose is not None for pose in poses])
        self._project(transforms, present)
        k = np.array([camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]], np.float32)
        shape = (-(-camera.height // SHRINK), -(-camera.width // SHRINK))
        depth = self._depth(k / np.float32(SHRINK), shape)
        boxes = _box_depths(log, transforms, present, k / np.float32(SHRINK), shape)
        self._gather(k, depth, boxes, _pyramid(image))
        return View(camera, frame, T_camera_world, image, depth, np.isfinite(boxes[0]))

    def mean(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Colours [N, 3] float32 in [0, 1], and which are known [N] bool; the others are 0."""
        n = len(self._means)
        colours, known = np.zeros((n, 3), dtype=np.float32), np.zeros(n, dtype=np.bool_)
        kernels.robust_mean(self._colours, self._weights, colours, known)
        return colours, known

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

    def _depth(self, k: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
        def work(part: slice) -> NDArray[np.float32]:
            depth = np.full(shape, np.inf, dtype=np.float32)
            kernels.splat_depth(
                self._in_camera[part], self._turned[part], self._radii[part], k, depth
            )
            return depth

        return np.asarray(np.minimum.reduce(self._on_all_cores(work)))

    def _gather(
        self,
        k: NDArray[np.float32],
        depth: NDArray[np.float32],
        boxes: _BoxDepths,
        pyramid: tuple[NDArray[np.uint8], ...],
    ) -> None:
        def work(part: slice) -> None:
            kernels.gather_samples(
                self._in_camera[part],
                self._turned[part],
                self._footprints[part],
                self._placed.instance[part],
                k,
                SHRINK,
                depth,
                *boxes,
                pyramid,
                self._colours[part],
                self._weights[part],
            )

        self._on_all_cores(work)

    def _on_all_cores(self, work: Callable[[slice], _Result]) -> list[_Result]:
        """Run ``work`` on ranges of Gaussians that together are all of them."""
        count = os.cpu_count() or 1
        bounds = [len(self._means) * i // count for i in range(count + 1)]
        with ThreadPoolExecutor(count) as pool:
            return list(pool.map(work, map(slice, bounds[:-1], bounds[1:])))


def gather_views(
    log: DrivingLog,
    placed: Placed,
    *,
    frames: list[int],
    slots: int,
    on_view: Callable[[View], None],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Colour all Gaussians from all cameras at ``frames``, occlusion respected.

    A view counts for a Gaussian when nothing lies before it in a depth image of all Gaussians,
    and the ray to it passes through no other object's box: car windows give no LiDAR returns,
    so depth alone would paint windows on the road behind. Of the ``slots`` nearest, most frontal
    views, those that agree with their median are averaged.

    Args:
        on_view: called with each view after it was looked at.

    Returns:
        Colours [N, 3] float32 in [0, 1], and which are known [N] bool.
    """
    samples = ColourSamples(placed, slots)
    for camera, frame, image in _images(log, frames):
        on_view(samples.add(log, camera, frame, image))
    return samples.mean()


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
    tracks = [
        t.trajectory.transform(t_us) if t.trajectory.covers(t_us) else None for t in log.tracks
    ]
    return [np.eye(4), *tracks]


def _box_depths(
    log: DrivingLog,
    transforms: Float,
    present: NDArray[np.bool_],
    k: NDArray[np.float32],
    shape: tuple[int, int],
) -> _BoxDepths:
    """Depth of the first box in each pixel, its instance, and depth of the second."""
    boxes = np.array([i for i in range(1, len(present)) if present[i]], dtype=np.int64)
    half = np.array([log.tracks[i - 1].size for i in boxes], np.float32).reshape(-1, 3) / 2
    half += np.array([BOX_MARGIN, BOX_MARGIN, BOX_MARGIN / 2], dtype=np.float32)
    T_box_camera = invert_transform(transforms[boxes])[:, :3].astype(np.float32)
    T_box_camera[:, 2, 3] -= BOX_MARGIN / 2
    first = np.full(shape, np.inf, dtype=np.float32)
    second = first.copy()
    first_box = np.full(shape, -1, dtype=np.int32)
    kernels.enter_boxes(T_box_camera, half, boxes, k, first, first_box, second)
    return first, first_box, second


def _pyramid(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], ...]:
    import cv2

    levels = [np.ascontiguousarray(image)]
    while len(levels) < PYRAMID:
        height, width = levels[-1].shape[:2]
        size = (max(1, width // 2), max(1, height // 2))
        levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))
    return tuple(levels)
