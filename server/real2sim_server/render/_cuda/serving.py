"""The backend that draws frames for serving: tables, launches, images.

Cameras of several requests (one size per request) and of several sessions on one scene are drawn
together. The number of launches and copies does not depend on the number of objects.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..backend import RasterRequest, StartedFrames, needs_gradients, warm_up_requests
from ..types import RasterOptions, RenderError, RenderOutput, WorldViews
from .frame_memory import (
    PAIRS_PER_SPLAT,
    REPORT_BYTES,
    DeviceScene,
    FrameMemory,
    Images,
    Tables,
    tables_of,
    tile_passes,
)
from .launcher import IMAGES, MAX_CAMERAS, PAIRS_WANTED, PIECE, SEEN_WANTED, CudaLauncher, Launcher

BY_TILE = 16
"""Added to the index of a sort pass that sorts pairs by tile."""
DEPTH_PASSES = 4
MAX_PIXELS = 1 << 30
"""Maximum number of pixels of a frame: kernels use 32-bit indices, and memory is limited."""
SEEN_SHARE = 4
"""Initial estimate: one in this many Gaussians is visible to a camera."""
FINISHED = {
    "rgb": "bytes",
    "depth": "solid",
    "instance": "instance",
    "median_depth": "median",
    "semantic": "semantic",
}
"""Final images by modality."""
OUTPUTS = {"depth": "depth", "instance": "instance", "median_depth": "median"}
"""Images on the device, by the option that enables them."""


class NvrtcBackend:
    """Rasterizer for an NVIDIA GPU, without gradients. Calls are serialised across threads."""

    name = "nvrtc"

    def __init__(self, launcher: Launcher | None = None) -> None:
        self._launcher = launcher or CudaLauncher()
        self.device = self._launcher.device
        self._device_scene = DeviceScene(self._launcher)
        self._memory = FrameMemory(self._launcher)
        self._lock = threading.RLock()

    @property
    def modalities(self) -> frozenset[str]:
        """Modalities that :meth:`frames` supports."""
        return frozenset(FINISHED)

    def warm_up(self) -> None:
        """Reserve memory by drawing a small frame."""
        for request in warm_up_requests():
            self.rasterize(request)

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw all cameras in one pass. Images stay on the device.

        Raises:
            RenderError: the request needs gradients.
        """
        return self.rasterize_batch([request])

    def rasterize_batch(self, requests: Sequence[RasterRequest]) -> RenderOutput:
        """Draw requests of one size and the same options together, see BatchBackend."""
        start = time.perf_counter()
        options = requests[0].options
        asked = (OUTPUTS[switch] for switch in OUTPUTS if getattr(options, switch))
        names = ["rgb", "alpha", *asked]
        parts: dict[str, list[Tensor]] = {name: [] for name in names}
        pieces = [(k, piece) for k, request in enumerate(requests) for piece in _pieces(request)]
        for batch in _batches(pieces):
            drawn = [piece for _, piece in batch]
            with self._lock:
                images = self._draw(drawn, names)
            cameras = sum(piece.cameras for piece in drawn)
            for name in names:
                shape = (cameras, drawn[0].height, drawn[0].width)
                parts[name].append(_tensor(images, name, shape))
        whole = {n: torch.cat(held) if len(held) > 1 else held[0] for n, held in parts.items()}
        return RenderOutput(
            rgb=whole["rgb"],
            alpha=whole["alpha"],
            depth=whole.get("depth"),
            instance=whole.get("instance"),
            median_depth=whole.get("median"),
            timing_ms={"total": (time.perf_counter() - start) * 1e3},
        )

    def rasterize_worlds(self, worlds: WorldViews, like: RasterRequest) -> RenderOutput:
        """Draw worlds with the same instances together, see BatchBackend."""
        Ks = torch.from_numpy(worlds.Ks)
        requests = [
            replace(
                like,
                instances=tuple(
                    replace(worlds.things[k], T_world_object=poses[k], t_us=int(t_us))
                    for k in np.flatnonzero(shown).tolist()
                ),
                viewmats=torch.from_numpy(viewmats),
                Ks=Ks,
            )
            for viewmats, poses, shown, t_us in zip(
                worlds.viewmats, worlds.poses, worlds.shown, worlds.times_us, strict=True
            )
        ]
        return self.rasterize_batch(requests)

    def frames(
        self, requests: Sequence[RasterRequest], modalities: Sequence[str]
    ) -> list[dict[str, NDArray[Any]]]:
        """Final images of all requests, see FrameBackend."""
        started = self.start_frames(requests, modalities)
        started.ready()
        return started.images

    def start_frames(
        self, requests: Sequence[RasterRequest], modalities: Sequence[str]
    ) -> StartedFrames:
        """Like :meth:`frames`, but returns once the images are drawn, see FrameBackend."""
        pieces = [(k, piece) for k, request in enumerate(requests) for piece in _pieces(request)]
        found: list[list[dict[str, NDArray[Any]]]] = [[] for _ in requests]
        copies = []
        for batch in _batches(pieces):
            drawn = self._frame([piece for _, piece in batch], modalities)
            copies.append(drawn.ready)
            for (k, _), images in zip(batch, drawn.images, strict=True):
                found[k].append(images)

        def ready() -> None:
            for copied in copies:
                copied()

        if any(len(parts) > 1 for parts in found):
            ready()
        whole = [
            parts[0]
            if len(parts) == 1
            else {name: np.concatenate([part[name] for part in parts]) for name in modalities}
            for parts in found
        ]
        return StartedFrames(whole, ready)

    def _frame(self, requests: Sequence[RasterRequest], modalities: Sequence[str]) -> StartedFrames:
        names = [FINISHED[name] for name in modalities]
        with self._lock:
            images = self._draw(requests, names)
            host = self._launcher.host_memory(len(images.memory))
            ready = self._launcher.copy_out(images.memory, host)
        memory = host.numpy()
        results, first = [], 0
        for request in requests:
            pixels = request.cameras * request.height * request.width
            shape = (request.cameras, request.height, request.width)
            results.append(
                {
                    modality: _section(memory, images, name, first, pixels).reshape(
                        *shape, *IMAGES[name][1]
                    )
                    for modality, name in zip(modalities, names, strict=True)
                }
            )
            first += pixels
        return StartedFrames(results, ready)

    def _draw(self, requests: Sequence[RasterRequest], names: Sequence[str]) -> Images:
        """Draw images on the device.

        Memory is sized by previous frames. A frame that needs more is drawn again.
        """
        if any(needs_gradients(request) for request in requests):
            raise RenderError(
                "backend 'nvrtc' draws without gradients; train with --backend cuda, which is "
                "gsplat: real2sim doctor --build-gpu"
            )
        memory = self._memory
        tables = tables_of(requests, self._device_scene, self._launcher)
        looked_at = int(
            (tables.objects["count"].astype(np.int64) * tables.objects["cameras"]).sum()
        )
        least = max(looked_at // SEEN_SHARE, PIECE)
        memory.reserve(least, PAIRS_PER_SPLAT * least)
        places = tables.objects["tones"].copy()
        while True:
            tables.objects["tones"] = places
            images = memory.images(names, tables.pixels)
            frame = memory.upload(tables, images, requests[0].options)
            self._launch(frame, tables)
            host = self._launcher.host_memory(REPORT_BYTES)
            host.copy_(images.memory[:REPORT_BYTES], non_blocking=True)
            self._launcher.wait()
            report = host.numpy().view(np.uint32)
            seen, pairs = int(report[SEEN_WANTED]), int(report[PAIRS_WANTED])
            if not tables.pieces or (
                seen <= memory.seen_capacity and pairs <= memory.pair_capacity
            ):
                return images
            memory.reserve(seen + seen // 4, pairs + pairs // 4)

    def _launch(self, frame: int, tables: Tables) -> None:
        """Queue the kernels of a frame."""
        launch, memory = self._launcher.launch, self._memory
        launch("find_seen", max(tables.pieces, 1), frame)
        if tables.pieces:
            launch("project_seen", tables.pieces, frame)
            for number in range(DEPTH_PASSES):
                self._sort(frame, number)
            launch("count_pairs", memory.seen_capacity // PIECE, frame)
            launch("make_pairs", memory.seen_capacity // PIECE, frame)
            for number in range(tile_passes(tables.tiles)):
                self._sort(frame, BY_TILE + number)
            launch("find_ranges", memory.sort_blocks, frame)
        launch("blend", tables.tiles, frame)

    def _sort(self, frame: int, argument: int) -> None:
        self._launcher.launch("count_digits", self._memory.sort_blocks, frame, argument)
        self._launcher.launch("scatter_digits", self._memory.sort_blocks, frame, argument)


def _pieces(request: RasterRequest) -> Iterator[RasterRequest]:
    """Split a request into parts of at most MAX_CAMERAS and, except for one image, MAX_PIXELS."""
    step = max(1, min(MAX_CAMERAS, MAX_PIXELS // (request.width * request.height)))
    for first in range(0, request.cameras, step):
        last = min(first + step, request.cameras)
        yield replace(request, viewmats=request.viewmats[first:last], Ks=request.Ks[first:last])


def _batches(
    pieces: Sequence[tuple[int, RasterRequest]],
) -> Iterator[list[tuple[int, RasterRequest]]]:
    """Group requests with the same options within the limits of a frame."""
    batch: list[tuple[int, RasterRequest]] = []
    cameras = pixels = 0
    for item in pieces:
        request = item[1]
        cameras += request.cameras
        pixels += request.cameras * request.width * request.height
        full = cameras > MAX_CAMERAS or pixels > MAX_PIXELS
        if batch and (full or not _alike(request.options, batch[0][1].options)):
            yield batch
            batch, cameras = [], request.cameras
            pixels = request.cameras * request.width * request.height
        batch.append(item)
    if batch:
        yield batch


def _alike(a: RasterOptions, b: RasterOptions) -> bool:
    """Whether options are equal apart from the background, which is per camera."""
    return replace(a, background=b.background) == b


def _tensor(images: Images, name: str, shape: tuple[int, int, int]) -> Tensor:
    """Images [C, H, W, ...] of all cameras of a frame, on the device."""
    start, nbytes = images.places[name]
    dtype, channels = IMAGES[name]
    flat = images.memory[start : start + nbytes]
    return flat.view(getattr(torch, np.dtype(dtype).name)).reshape(*shape, *channels)


def _section(
    memory: NDArray[np.uint8], images: Images, name: str, first: int, pixels: int
) -> NDArray[Any]:
    """Values of ``pixels`` pixels starting at ``first``, in host memory."""
    dtype, channels = IMAGES[name]
    each = np.dtype(dtype).itemsize * int(np.prod(channels))
    start = images.places[name][0] + first * each
    return memory[start : start + pixels * each].view(dtype)
