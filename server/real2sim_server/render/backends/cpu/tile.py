"""Lists of the records that touch each 16x16 tile, in depth order.

Records are taken in depth order and counted, then scattered, so the lists need no sorting of their
own. Chunks of fixed number have cursors of their own, which keeps the order for any thread count.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .footprint import tile_columns, tile_rows
from .kernel import kernel
from .simd import prefetch

TILE_CHUNKS = 8
LOOK_AHEAD = 24
LOW_BITS = np.uint64(0xFFFFFFFF)


@kernel(parallel=PARALLEL_LOOPS)
def count_tiles(values, footprints, order, tiles_x, ordered_footprints, counts):
    """Count the records of each chunk in each tile.

    Args:
        values, footprints: of Records.
        order: [N] uint64, record indices in the low 32 bits, near to far.
        tiles_x: tiles in a row of the image.
        ordered_footprints: [N] int64, written: footprints in the order of ``order``.
        counts: [TILE_CHUNKS, tiles] int64, written.
    """
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        counts[chunk, :] = 0
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            prefetch(footprints, np.int64(order[min(i + LOOK_AHEAD, total - 1)] & LOW_BITS))
            index = np.int64(order[i] & LOW_BITS)
            footprint = footprints[index]
            ordered_footprints[i] = footprint
            first, last = tile_rows(footprint)
            for row in range(first, last):
                left, right = tile_columns(values, footprint, index, row)
                for column in range(left, right):
                    counts[chunk, row * tiles_x + column] += 1


@kernel()
def tile_starts(counts, first_tile, last_tile, starts):
    """Turn counts of tiles [first_tile, last_tile) into cursors of each chunk and tile starts."""
    position = 0
    for tile in range(first_tile, last_tile):
        starts[tile] = position
        for chunk in range(counts.shape[0]):
            count = counts[chunk, tile]
            counts[chunk, tile] = position
            position += count
    starts[last_tile] = position


@kernel(parallel=PARALLEL_LOOPS)
def scatter_tiles(values, ordered_footprints, order, tiles_x, first_row, last_row, cursors, lists):
    """Write record indices of tile rows [first_row, last_row) to ``lists`` int32."""
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            index = np.int64(order[i] & LOW_BITS)
            footprint = ordered_footprints[i]
            first, last = tile_rows(footprint)
            for row in range(max(first, first_row), min(last, last_row)):
                left, right = tile_columns(values, footprint, index, row)
                for column in range(left, right):
                    tile = row * tiles_x + column
                    lists[cursors[chunk, tile]] = index
                    cursors[chunk, tile] += 1
