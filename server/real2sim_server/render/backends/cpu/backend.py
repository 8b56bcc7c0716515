"""The CPU backend: Numba kernels on all cores.

One camera at a time: every cluster is projected where it lies, the records are sorted by depth,
dealt to tiles and blended. Work space grows to what was needed and is kept.

A request that may be interrupted is worked on in pieces; what is drawn in between has a work space
of its own. The pieces change no bit: tiles and rows know nothing of each other.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...types import RenderOutput, Sky, WorldViews
from ..base import (
    Placement,
    RasterRequest,
    direction_matrix,
    is_reduced,
    needs_gradients,
    place_instances,
    with_colours,
)
from ..warm_up import warm_up_requests
from .blend import blend_tiles
from .cull import Chunks, seen_chunks
from .detail.images import SmallImages
from .gradients import TrainingPasses
from .inputs import Workspace, array_of, project, timed, view_of
from .records import TILE, Images, Records
from .sky import add_sky
from .sort import sort_records
from .tile import TILE_CHUNKS, count_tiles, scatter_tiles, tile_starts

LIST_BUDGET = 1 << 26
"""Entries of tile lists held at once; larger pictures are made in bands of tile rows."""


PIECE_PIXELS = 1 << 18
"""Pixels blended, or given a sky, in one piece of work, where a request may be interrupted."""


class CpuBackend:
    """Rasterizer for any CPU. One call at a time; those of other threads wait."""

    name = "cpu"

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._idle_spaces: list[Workspace] = []
        self._training = TrainingPasses(self._lock)
        self._small = SmallImages()

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw one camera after the other into shared output arrays."""
        if is_reduced(request):
            return self.rasterize_batch([request])
        if needs_gradients(request):
            return self._training.rasterize(with_colours(request))
        shape = (request.cameras, request.height, request.width)
        options = request.options
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        depth = np.empty(shape if options.depth else (shape[0], 0, 0), np.float32)
        instance = np.empty(shape if options.instance else (shape[0], 0, 0), np.uint16)
        median = np.empty(shape if options.median_depth else (shape[0], 0, 0), np.float32)
        timing: dict[str, float] = dict.fromkeys(("project", "sort", "tile", "blend", "sky"), 0.0)
        placement = place_instances(request.instances, request.viewmats.detach().cpu())
        with self._work_space() as space:
            with timed(timing, "project"):
                views = [view_of(request, c) for c in range(request.cameras)]
                seen = seen_chunks(request, placement, views)
            for c in range(request.cameras):
                images = Images(rgb[c], alpha[c], depth[c], instance[c], median[c])
                drawing = _Drawing(request, c, images, space, timing)
                drawing.draw(placement, seen[c])
        return RenderOutput(
            rgb=torch.from_numpy(rgb),
            alpha=torch.from_numpy(alpha),
            depth=torch.from_numpy(depth) if options.depth else None,
            instance=torch.from_numpy(instance) if options.instance else None,
            timing_ms=timing,
            between=request.between,
            median_depth=torch.from_numpy(median) if options.median_depth else None,
        )

    def rasterize_batch(self, requests: Sequence[RasterRequest]) -> RenderOutput:
        """Draw small images of many requests at once, see SmallImages."""
        with self._lock:
            return self._small.draw(requests)

    def rasterize_worlds(self, worlds: WorldViews, like: RasterRequest) -> RenderOutput:
        """Draw small images of many worlds of the same things at once, see SmallImages."""
        with self._lock:
            return self._small.draw_worlds(worlds, like)

    def warm_up(self) -> None:
        """Compile every kernel, or load it from the disk cache."""
        for request in warm_up_requests():
            self.rasterize(request)

    @contextmanager
    def _work_space(self) -> Iterator[Workspace]:
        """Space that nobody else uses, also not who interrupts the block on its own thread."""
        with self._lock:
            space = self._idle_spaces.pop() if self._idle_spaces else Workspace()
            try:
                yield space
            finally:
                self._idle_spaces.append(space)


@dataclass(frozen=True, eq=False)
class _Drawing:
    """One camera of a request on its way to ``images``.

    Attributes:
        space: to work in.
        timing: gets milliseconds by stage.
    """

    request: RasterRequest
    camera: int
    images: Images
    space: Workspace
    timing: dict[str, float]

    def draw(self, placement: Placement, chunks: Sequence[Chunks]) -> None:
        """Project, sort, blend and add the sky."""
        with timed(self.timing, "project"):
            records, regions = project(self.request, placement, self.camera, chunks, self.space)
        self._pause()
        with timed(self.timing, "sort"):
            pairs = self.space.array("pairs", (int(records.counts[:regions].sum()),), np.uint64)
            scratch = self.space.array("pairs_scratch", pairs.shape, np.uint64)
            order = sort_records(records, regions, pairs, scratch)
        self._pause()
        self._blend(records, order)
        if self.request.sky is not None:
            self._add_sky(self.request.sky)

    def _pause(self) -> None:
        """The end of a piece."""
        if self.request.between is not None:
            self.request.between()

    def _blend(self, records: Records, order: NDArray[np.uint64]) -> None:
        request, space = self.request, self.space
        tiles_x, tiles_y = -(-request.width // TILE), -(-request.height // TILE)
        background = (0.0, 0.0, 0.0) if request.sky is not None else request.options.background
        behind = np.array(background, np.float32)
        starts = space.array("starts", (tiles_x * tiles_y + 1,), np.int64)
        with timed(self.timing, "tile"):
            cursors = space.array("cursors", (TILE_CHUNKS, tiles_x * tiles_y), np.int64)
            footprints = space.array("ordered_footprints", order.shape, np.int64)
            count_tiles(records.values, records.footprints, order, tiles_x, footprints, cursors)
            bands = _bands(cursors.sum(0).reshape(tiles_y, tiles_x).sum(1), self._rows(TILE))
        for first, last in bands:
            self._pause()
            tiles = first * tiles_x, last * tiles_x
            with timed(self.timing, "tile"):
                tile_starts(cursors, *tiles, starts)
                lists = space.array("lists", (int(starts[tiles[1]]),), np.int32)
                rows = first, last
                scatter_tiles(records.values, footprints, order, tiles_x, *rows, cursors, lists)
            with timed(self.timing, "blend"):
                blend_tiles(records.values, lists, starts, tiles_x, *tiles, behind, self.images)

    def _add_sky(self, sky: Sky) -> None:
        matrix, images = array_of(direction_matrix(self.request, self.camera)), self.images
        step = self._rows(1)
        for first in range(0, self.request.height, step):
            self._pause()
            rows = slice(first, first + step)
            with timed(self.timing, "sky"):
                add_sky(array_of(sky.faces), matrix, first, images.rgb[rows], images.alpha[rows])

    def _rows(self, height: int) -> int:
        """Rows of that height [px] in one piece; all of them where nobody interrupts."""
        if self.request.between is None:
            return -(-self.request.height // height)
        return max(1, PIECE_PIXELS // (self.request.width * height))


def _bands(row_totals: NDArray[np.int64], most: int) -> Iterator[tuple[int, int]]:
    """Ranges of at most ``most`` tile rows whose lists fit LIST_BUDGET together, at least one row
    each."""
    first, held = 0, 0
    for row, total in enumerate(row_totals):
        if row > first and (held + total > LIST_BUDGET or row - first >= most):
            yield first, row
            first, held = row, 0
        held += int(total)
    yield first, len(row_totals)
