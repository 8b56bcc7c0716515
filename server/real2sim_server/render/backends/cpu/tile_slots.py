"""Tile lists for a pass that will be walked backwards.

Each place in a tile's list also has a slot of its own where the gradients of this record in this
tile go. The slots of one record lie side by side, so that they can be summed in a fixed order
without locks.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .footprint import tile_columns, tile_rows
from .kernel import kernel
from .tile import LOW_BITS, TILE_CHUNKS


@kernel(parallel=PARALLEL_LOOPS)
def scatter_slots(values, footprints, order, tiles_x, first_slots, cursors, lists, slots, spans):
    """Like scatter_tiles for the whole picture, and number the places by record.

    Args:
        values, footprints, order, tiles_x, cursors: as for scatter_tiles.
        first_slots: [TILE_CHUNKS] int64, number of places in the chunks before.
        lists: [L] int32, written: record at each place.
        slots: [L] int32, written: slot of each place.
        spans: [M, 2] int32, written for each record in ``order``: its slots [first, last).
    """
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        slot = first_slots[chunk]
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            index = np.int64(order[i] & LOW_BITS)
            footprint = footprints[i]
            first, last = tile_rows(footprint)
            spans[index, 0] = slot
            for row in range(first, last):
                left, right = tile_columns(values, footprint, index, row)
                for column in range(left, right):
                    tile = row * tiles_x + column
                    place = cursors[chunk, tile]
                    lists[place] = index
                    slots[place] = slot
                    cursors[chunk, tile] = place + 1
                    slot += 1
            spans[index, 1] = slot
