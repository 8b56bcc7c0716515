"""Lists of the records that touch each 16x16 tile, in depth order.

Records are taken in depth order and counted, then scattered, so the lists need no sorting of their
own. Chunks of fixed number have cursors of their own, which keeps the order for any thread count.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange

from .cpu_records import (
    EXPONENT_LIMIT,
    EXTENT_Y,
    FALLOFF,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    SHARPNESS,
    SLOPE,
    TILE,
    TIP_Y,
)
from .cpu_simd import prefetch
from .kernel import inlined, kernel

TILE_CHUNKS = 8
LOOK_AHEAD = 24
F32 = np.float32
LIMIT, HALF, PER_TILE = F32(EXPONENT_LIMIT), F32(0.5), F32(1.0 / TILE)
LOW_BITS = np.uint64(0xFFFFFFFF)
SLACK = F32(0.01)
"""Spans are widened by this [px] against rounding; the blending decides exactly."""


@kernel(parallel=True)
def count_tiles(values, boxes, order, tiles_x, ordered_boxes, counts):
    """Count the records of each chunk in each tile.

    Args:
        values, boxes: of Records.
        order: [N] uint64, record indices in the low 32 bits, near to far.
        tiles_x: tiles in a row of the image.
        ordered_boxes: [N] int64, written: boxes in the order of ``order``.
        counts: [TILE_CHUNKS, tiles] int64, written.
    """
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        counts[chunk, :] = 0
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            prefetch(boxes, np.int64(order[min(i + LOOK_AHEAD, total - 1)] & LOW_BITS))
            index = np.int64(order[i] & LOW_BITS)
            box = boxes[index]
            ordered_boxes[i] = box
            first, last = tile_rows(box)
            for row in range(first, last):
                left, right = tile_columns(values, box, index, row)
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


@kernel(parallel=True)
def scatter_tiles(values, ordered_boxes, order, tiles_x, first_row, last_row, cursors, lists):
    """Write record indices of tile rows [first_row, last_row) to ``lists`` int32."""
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            index = np.int64(order[i] & LOW_BITS)
            box = ordered_boxes[i]
            first, last = tile_rows(box)
            for row in range(max(first, first_row), min(last, last_row)):
                left, right = tile_columns(values, box, index, row)
                for column in range(left, right):
                    tile = row * tiles_x + column
                    lists[cursors[chunk, tile]] = index
                    cursors[chunk, tile] += 1


@inlined()
def tile_rows(box):
    """Range of tile rows of a box."""
    return (box >> 32) & 0xFFFF, (box >> 48) & 0xFFFF


@inlined()
def tile_columns(values, box, index, row):
    """Range of tile columns where the ellipse meets the pixel centres of a tile row.

    A box one tile wide or high is its own answer, which spares most records a look-up.
    """
    first, last = box & 0xFFFF, (box >> 16) & 0xFFFF
    top, bottom = tile_rows(box)
    if last - first < 2 or bottom - top < 2:
        return first, last
    record = values[index]
    y0 = F32(row * TILE) + HALF - record[MEAN_Y]
    y1 = y0 + F32(TILE - 1)
    centre = record[MEAN_X] - HALF
    right = (centre + side_reach(record, y0, y1, record[TIP_Y], F32(1)) + SLACK) * PER_TILE
    left = (centre + side_reach(record, y0, y1, -record[TIP_Y], F32(-1)) - SLACK) * PER_TILE
    first = max(first, np.int64(math.floor(max(left, F32(0)))))
    return first, min(last, np.int64(math.floor(min(right, F32(last)))) + 1)


@inlined()
def side_reach(record, y0, y1, tip, side):
    """Outermost dx of the ellipse on one side (``side`` = ±1) for dy in [y0, y1]."""
    dy = min(max(tip, y0), y1)
    dy = min(max(dy, -record[EXTENT_Y]), record[EXTENT_Y])
    room = max(LIMIT - record[LEVEL] - record[FALLOFF] * dy * dy, F32(0))
    return record[SLOPE] * dy + side * math.sqrt(room) / record[SHARPNESS]
