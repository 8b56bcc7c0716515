"""Training images of a log: split, downscaled, cached, in a fixed order."""

from __future__ import annotations

from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...logs import DrivingLog, LidarSweep, log_of_frames
from ...scene import Camera
from ..logged_view import below_horizon, image_time, points_in_camera, resized, sky_mask
from ..options import ReconstructError
from .schedule import TrainOptions

NEAR, FAR = 0.5, 80.0
"""Range of the compared LiDAR depths [m]."""
SKY_BORDER = 1.5
"""Width of the border of the sky mask with reduced weight [px]."""
PREFETCH = 4
"""Number of images decoded ahead of their step."""


def held_out_frames(frame_count: int, every: int) -> list[int]:
    """Frames excluded from training: the third of each group of ``every``; none for ``every`` = 0.

    If ``every`` is 4 or more, neither the first nor the last frame of a drive is held out, so every
    held-out frame is between two training frames.
    """
    if every == 0:
        return []
    return list(range(min(2, every - 1), frame_count - 1, every))


def training_log(log: DrivingLog, hold_out: int) -> DrivingLog:
    """``log`` without the held-out frames. Paths and boxes stay complete."""
    held_out = set(held_out_frames(log.frame_count, hold_out))
    return log_of_frames(log, [f for f in range(log.frame_count) if f not in held_out])


@dataclass(frozen=True, eq=False)
class TrainingView:
    """One training image.

    Attributes:
        camera: camera at the size of ``image``.
        frame: index in the log.
        t_us: time of the image [us].
        image: [H, W, 3] float32 in [0, 1].
        pixels: [M] int64, row-major pixels with a LiDAR return.
        depths: [M] float32 along the camera's z [m].
        sky: [H, W] float32, 1 in the sky, less near its border, -1 below the horizon and 0
            elsewhere; None if no loss uses it.
    """

    camera: Camera
    frame: int
    t_us: int
    image: Tensor
    pixels: Tensor
    depths: Tensor
    sky: Tensor | None = None


@dataclass(frozen=True, eq=False)
class _CachedImage:
    image: NDArray[np.uint8]
    points: NDArray[np.float32]
    sky: NDArray[np.int8] | None

    @property
    def nbytes(self) -> int:
        sky = 0 if self.sky is None else self.sky.nbytes
        return self.image.nbytes + self.points.nbytes + sky


class TrainingViews:
    """The views of some frames of a log.

    Decoded images are cached up to ``options.image_bytes``; the least recently used are evicted.

    Args:
        log: log with cameras.
        frames: indices into ``log``.
        options: training options.
        device: device of the returned views. Other devices than the CPU cache views as bytes, also
            up to ``options.image_bytes``, so that later epochs copy nothing.

    Raises:
        ReconstructError: no view is available.
    """

    def __init__(
        self,
        log: DrivingLog,
        frames: list[int],
        options: TrainOptions,
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        self._log, self._options = log, options
        self._keys = [
            (name, frame)
            for frame in frames
            for name in log.rig.names
            if log.has_image(name, frame)
        ]
        if not self._keys:
            raise ReconstructError(f"log {log.name!r} has no image to train on")
        self._cache: OrderedDict[int, _CachedImage] = OrderedDict()
        self._nbytes = 0
        self._device = torch.device(device)
        self._resident: OrderedDict[tuple[int, int], TrainingView] = OrderedDict()
        self._resident_bytes = 0
        self._pending: dict[int, Future[_CachedImage]] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="views")

    def __len__(self) -> int:
        return len(self._keys)

    def close(self) -> None:
        """Stop reading ahead."""
        self._pool.shutdown(cancel_futures=True)

    def viewpoints(self) -> list[tuple[Camera, int]]:
        """Camera at full training size and time [us] of every view."""
        rig, found = self._log.rig, []
        for name, frame in self._keys:
            camera = rig[name].resized(max(16, self._width(rig[name])))
            found.append((camera, image_time(self._log, name, frame)))
        return found

    def sample_viewpoints(self, count: int) -> list[tuple[Camera, int]]:
        """At most ``count`` of :meth:`viewpoints`, split among the cameras and evenly spread over
        time.

        Gaussians that none of them shows count as hidden, so the gaps in time are as short as
        possible.
        """
        viewpoints, count = self.viewpoints(), min(count, len(self))
        by_camera = sorted(range(len(self)), key=lambda k: self._keys[k][0])
        places = (np.arange(count) + 0.5) * (len(self) / max(1, count))
        return [viewpoints[by_camera[int(place)]] for place in places]

    def index_at(self, iteration: int) -> int:
        """Index of the view of ``iteration``. Every epoch visits all views in a new order."""
        epoch, place = divmod(iteration, len(self))
        rng = np.random.Generator(np.random.Philox(key=[self._options.seed, epoch]))
        return int(rng.permutation(len(self))[place])

    def prefetch(self, iteration: int) -> None:
        """Start reading the images of the next iterations."""
        for ahead in range(1, PREFETCH + 1):
            index = self.index_at(iteration + ahead)
            if index not in self._cache and index not in self._pending:
                self._pending[index] = self._pool.submit(self._read, index)

    def view(self, index: int, divisor: int = 1) -> TrainingView:
        """The view at ``index``, at a ``divisor``-th of the training width.

        Raises:
            LogError: its image or sweep cannot be read.
        """
        if self._device.type != "cpu":
            return self._on_device(index, divisor)
        return self._as_floats(self._bytes(index, divisor))

    def _on_device(self, index: int, divisor: int) -> TrainingView:
        """The view on its device, copied there on first use."""
        key = (index, divisor)
        kept = self._resident.pop(key, None)
        if kept is None:
            held = self._bytes(index, divisor)
            parts: dict[str, Any] = {k: p.to(self._device) for k, p in _parts(held).items()}
            kept = replace(held, **parts)
            self._resident_bytes += _nbytes(kept)
        self._resident[key] = kept
        while self._resident_bytes > self._options.image_bytes and len(self._resident) > 1:
            self._resident_bytes -= _nbytes(self._resident.popitem(last=False)[1])
        return self._as_floats(kept)

    def _as_floats(self, view: TrainingView) -> TrainingView:
        return replace(view, image=view.image.float() / 255)

    def _bytes(self, index: int, divisor: int) -> TrainingView:
        """The view with an image of bytes, on the CPU."""
        stored = self._stored(index)
        name, frame = self._keys[index]
        width = self._width(self._log.rig[name])
        camera = self._log.rig[name].resized(max(16, width // divisor))
        pixels, depths = _pixels(stored.points, camera)
        image = np.ascontiguousarray(resized(stored.image, camera))
        sky = None if stored.sky is None else torch.from_numpy(_weights(stored.sky, camera))
        return TrainingView(
            camera=camera,
            frame=frame,
            t_us=image_time(self._log, name, frame),
            image=torch.from_numpy(image),
            pixels=torch.from_numpy(pixels),
            depths=torch.from_numpy(depths),
            sky=sky,
        )

    def _width(self, camera: Camera) -> int:
        options = self._options
        return min(options.width or camera.width, options.max_width, camera.width)

    def _stored(self, index: int) -> _CachedImage:
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        pending = self._pending.pop(index, None)
        stored = pending.result() if pending is not None else self._read(index)
        self._cache[index] = stored
        self._nbytes += stored.nbytes
        while self._nbytes > self._options.image_bytes and len(self._cache) > 1:
            self._nbytes -= self._cache.popitem(last=False)[1].nbytes
        return stored

    def _read(self, index: int) -> _CachedImage:
        name, frame = self._keys[index]
        log, losses, full = self._log, self._options.losses, self._log.rig[name]
        small = full.resized(self._width(full))
        image, sweep = resized(log.image(name, frame), small), log.lidar(frame)
        sky = None
        if losses.sky > 0:
            sky = sky_mask(log, small, frame, image, sweep=sweep).astype(np.int8)
            sky[below_horizon(log, small, frame)] = -1
        return _CachedImage(image, self._points(full, frame, sweep), sky)

    def _points(self, camera: Camera, frame: int, sweep: LidarSweep) -> NDArray[np.float32]:
        """LiDAR points [M, 3] in the camera frame, those the image may show."""
        if self._options.losses.depth <= 0:
            return np.zeros((0, 3), np.float32)
        t_us = image_time(self._log, camera.name, frame)
        points = points_in_camera(self._log, camera, frame, t_us, sweep=sweep)
        x, y, z = points.T
        safe = np.where(z > NEAR, z, 1.0)
        u = camera.K[0, 0] * x / safe + camera.K[0, 2]
        v = camera.K[1, 1] * y / safe + camera.K[1, 2]
        inside = (z > NEAR) & (z < FAR) & (u >= 0) & (u < camera.width)
        inside &= (v >= 0) & (v < camera.height)
        chosen = np.flatnonzero(inside)
        # Points are sorted by angle; a stride coprime to the number of beams spreads the selection.
        step = max(1, len(chosen) // self._options.depth_points) | 1
        return points[chosen[::step]].astype(np.float32)


def _parts(view: TrainingView) -> dict[str, Tensor]:
    parts = {name: getattr(view, name) for name in ("image", "pixels", "depths", "sky")}
    return {name: part for name, part in parts.items() if part is not None}


def _nbytes(view: TrainingView) -> int:
    return sum(part.numel() * part.element_size() for part in _parts(view).values())


def _weights(sky: NDArray[np.int8], camera: Camera) -> NDArray[np.float32]:
    """[H, W] of ``sky`` at the size of ``camera``, see TrainingView; less than 1 within SKY_BORDER
    of the edge of the sky.
    """
    import cv2

    whole, solid = (
        (resized((sky == value).astype(np.uint8) * 255, camera) == 255).astype(np.uint8)
        for value in (1, -1)
    )
    within = cv2.distanceTransform(whole, cv2.DIST_L2, 5) / SKY_BORDER
    return np.asarray(np.minimum(within, 1) - solid, np.float32)


def _pixels(
    points: NDArray[np.float32], camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Pixels hit by points in the camera frame, the nearest point in each."""
    x, y, z = points.T
    u = np.floor(camera.K[0, 0] * x / z + camera.K[0, 2]).astype(np.int64)
    v = np.floor(camera.K[1, 1] * y / z + camera.K[1, 2]).astype(np.int64)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    flat, depth = (v * camera.width + u)[inside], z[inside]
    order = np.lexsort((depth, flat))
    flat, depth = flat[order], depth[order]
    first = np.ones(len(flat), dtype=np.bool_)
    first[1:] = flat[1:] != flat[:-1]
    return flat[first], depth[first]


__all__ = [
    "TrainingView",
    "TrainingViews",
    "held_out_frames",
    "training_log",
]
