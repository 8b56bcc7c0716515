"""The CPU backend: Numba kernels on all cores.

One camera at a time: every cluster is projected where it lies, the records are sorted by depth,
dealt to tiles and blended. Work space grows to what was needed and is kept.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ...types import RenderOutput
from ..base import (
    Placement,
    RasterRequest,
    direction_matrix,
    needs_gradients,
    place_instances,
    with_colours,
)
from ..warm_up import warm_up_requests
from .blend import blend_tiles
from .cull import Chunks, seen_chunks
from .gradients import TrainingPasses
from .inputs import Workspace, array_of, project, timed, view_of
from .records import TILE, Images, Records
from .sky import add_sky
from .sort import sort_records
from .tile import TILE_CHUNKS, count_tiles, scatter_tiles, tile_starts

LIST_BUDGET = 1 << 26
"""Entries of tile lists held at once; larger pictures are made in bands of tile rows."""


class CpuBackend:
    """Rasterizer for any CPU. One call at a time; further ones wait."""

    name = "cpu"

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._space = Workspace()
        self._training = TrainingPasses(self._lock)

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw one camera after the other into shared output arrays."""
        if needs_gradients(request):
            return self._training.rasterize(with_colours(request))
        shape = (request.cameras, request.height, request.width)
        options = request.options
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        depth = np.empty(shape if options.depth else (shape[0], 0, 0), np.float32)
        instance = np.empty(shape if options.instance else (shape[0], 0, 0), np.uint16)
        timing: dict[str, float] = dict.fromkeys(("project", "sort", "tile", "blend", "sky"), 0.0)
        placement = place_instances(request.instances, request.viewmats.detach().cpu())
        with self._lock:
            with timed(timing, "project"):
                views = [view_of(request, c) for c in range(request.cameras)]
                seen = seen_chunks(request, placement, views)
            for c in range(request.cameras):
                images = Images(rgb[c], alpha[c], depth[c], instance[c])
                self._draw(request, placement, c, chunks=seen[c], images=images, timing=timing)
        return RenderOutput(
            rgb=torch.from_numpy(rgb),
            alpha=torch.from_numpy(alpha),
            depth=torch.from_numpy(depth) if options.depth else None,
            instance=torch.from_numpy(instance) if options.instance else None,
            timing_ms=timing,
        )

    def warm_up(self) -> None:
        """Compile every kernel, or load it from the disk cache."""
        for request in warm_up_requests():
            self.rasterize(request)

    def _draw(
        self,
        request: RasterRequest,
        placement: Placement,
        camera: int,
        *,
        chunks: Sequence[Chunks],
        images: Images,
        timing: dict[str, float],
    ) -> None:
        with timed(timing, "project"):
            records, regions = project(request, placement, camera, chunks, self._space)
        with timed(timing, "sort"):
            pairs = self._space.array("pairs", (int(records.counts[:regions].sum()),), np.uint64)
            scratch = self._space.array("pairs_scratch", pairs.shape, np.uint64)
            order = sort_records(records, regions, pairs, scratch)
        self._blend(request, records, order, images, timing)
        if request.sky is not None:
            with timed(timing, "sky"):
                matrix = array_of(direction_matrix(request, camera))
                add_sky(array_of(request.sky.faces), matrix, images.rgb, images.alpha)

    def _blend(
        self,
        request: RasterRequest,
        records: Records,
        order: NDArray[np.uint64],
        images: Images,
        timing: dict[str, float],
    ) -> None:
        tiles_x, tiles_y = -(-request.width // TILE), -(-request.height // TILE)
        background = (0.0, 0.0, 0.0) if request.sky is not None else request.options.background
        behind = np.array(background, np.float32)
        starts = self._space.array("starts", (tiles_x * tiles_y + 1,), np.int64)
        with timed(timing, "tile"):
            cursors = self._space.array("cursors", (TILE_CHUNKS, tiles_x * tiles_y), np.int64)
            footprints = self._space.array("ordered_footprints", order.shape, np.int64)
            count_tiles(records.values, records.footprints, order, tiles_x, footprints, cursors)
            bands = _bands(cursors.sum(0).reshape(tiles_y, tiles_x).sum(1))
        for first, last in bands:
            tiles = first * tiles_x, last * tiles_x
            with timed(timing, "tile"):
                tile_starts(cursors, *tiles, starts)
                lists = self._space.array("lists", (int(starts[tiles[1]]),), np.int32)
                rows = first, last
                scatter_tiles(records.values, footprints, order, tiles_x, *rows, cursors, lists)
            with timed(timing, "blend"):
                blend_tiles(records.values, lists, starts, tiles_x, *tiles, behind, images)


def _bands(row_totals: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Ranges of tile rows whose lists fit LIST_BUDGET together, at least one row each."""
    first, held = 0, 0
    for row, total in enumerate(row_totals):
        if row > first and held + total > LIST_BUDGET:
            yield first, row
            first, held = row, 0
        held += int(total)
    yield first, len(row_totals)
