"""Lists of the records that each tile of rays may meet, from near to far."""

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from ...backends.cpu.kernel import inlined, kernel
from ...backends.cpu.simd import prefetch
from .layout import AZIMUTH_BINS

TILE_CHUNKS = 8
LOOK_AHEAD = 24
LOW_BITS = np.uint64(0xFFFFFFFF)


@kernel(parallel=PARALLEL_LOOPS)
def count_rays(footprints, order, layout, ordered, counts):
    """Count the records of each chunk in each tile.

    Args:
        footprints: of Records.
        order: [N] uint64, record indices in the low 32 bits, near to far.
        ordered: [N] int64, written: footprints in that order.
        counts: [TILE_CHUNKS, tiles] int64, written.
    """
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    unused = np.empty(0, np.int32)
    for chunk in prange(TILE_CHUNKS):
        counts[chunk, :] = 0
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            prefetch(footprints, np.int64(order[min(i + LOOK_AHEAD, total - 1)] & LOW_BITS))
            footprint = footprints[np.int64(order[i] & LOW_BITS)]
            ordered[i] = footprint
            visit(footprint, layout, counts[chunk], unused, np.int32(0))


@kernel(parallel=PARALLEL_LOOPS)
def scatter_rays(ordered, order, layout, cursors, lists):
    """Write record indices to ``lists`` int32, by the cursors [TILE_CHUNKS, tiles]."""
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            index = np.int32(order[i] & LOW_BITS)
            visit(ordered[i], layout, cursors[chunk], lists, index)


@inlined()
def visit(footprint, layout, cursors, lists, index):
    """Step the cursor of each tile that a footprint meets, and write ``index`` there where lists
    are given."""
    band, last_band = footprint & 255, (footprint >> 8) & 255
    first_bin, last_bin = (footprint >> 16) & 8191, (footprint >> 29) & 8191
    side = footprint >> 42
    while band <= last_band:
        begin, end = first_bin, min(last_bin, AZIMUTH_BINS - 1)
        beyond = last_bin - AZIMUTH_BINS
        tile_end = layout.band_starts[band + 1]
        while begin <= end:
            tile = np.int64(layout.first_tiles[band, begin])
            if begin == 0 and first_bin > 0:
                # Behind +-pi: tiles that the part before has met already are left out.
                tile_end = min(tile_end, np.int64(layout.first_tiles[band, first_bin]))
            while tile < tile_end and layout.tile_lows[tile] <= end:
                met = side == 0 or layout.sides[tile] == side
                if met and layout.tile_highs[tile] >= begin:
                    if lists.shape[0] > 0:
                        lists[cursors[tile]] = index
                    cursors[tile] += 1
                tile += 1
            begin, end, beyond = np.int64(0), beyond, np.int64(-1)
            if end < 0:
                break
        band += 1
