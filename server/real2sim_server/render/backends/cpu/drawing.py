"""One camera on its way from Gaussians to images, in pieces between which others may draw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...types import Sky
from ..base import Placement, RasterRequest, direction_matrix
from .blend import blend_tiles
from .cull import Chunks
from .inputs import Workspace, array_of, project, timed
from .records import TILE, Images, Records
from .sky import add_sky
from .sort import sort_records
from .tile import TILE_CHUNKS, count_tiles, scatter_tiles, tile_starts

LIST_BUDGET = 1 << 26
"""Entries of tile lists held at once; larger pictures are made in bands of tile rows."""
PIECE_PIXELS = 1 << 18
"""Pixels blended, or given a sky, in one piece of work, where a request may be interrupted."""


@dataclass(frozen=True, eq=False)
class Drawing:
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
            records, regions = self._project(placement, chunks)
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

    def _project(self, placement: Placement, chunks: Sequence[Chunks]) -> tuple[Records, int]:
        """Records, and the number of regions that they fill."""
        return project(self.request, placement, self.camera, chunks, self.space)

    def _blend_tiles(
        self,
        records: Records,
        lists: NDArray[np.int32],
        starts: NDArray[np.int64],
        tiles: tuple[int, int],
        behind: NDArray[np.float32],
    ) -> None:
        """Blend a range of tiles."""
        tiles_x = -(-self.request.width // TILE)
        blend_tiles(records.values, lists, starts, tiles_x, *tiles, behind, self.images)

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
                self._blend_tiles(records, lists, starts, tiles, behind)

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
