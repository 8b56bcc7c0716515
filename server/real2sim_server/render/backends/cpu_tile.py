"""Lists of the records that touch each 16x16 tile, in depth order.

Records are taken in depth order and counted, then scattered, so the lists need no sorting of their
own. Chunks of fixed number have cursors of their own, which keeps the order for any thread count.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

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

TILE_CHUNKS = 8
F32 = np.float32
LIMIT = F32(EXPONENT_LIMIT)
SLACK = F32(0.01)
"""Spans are widened by this [px] against rounding; the blending decides exactly."""


@njit(parallel=True, cache=True, error_model="numpy")
def count_tiles(values, order, tiles_x, tiles_y, counts):
    """Fill ``counts`` [TILE_CHUNKS, tiles] int32: records of each chunk in each tile."""
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        counts[chunk, :] = 0
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            record = values[np.int64(order[i] & np.uint64(0xFFFFFFFF))]
            first, last = tile_rows(record, 0, tiles_y)
            for row in range(first, last):
                left, right = tile_columns(record, row, tiles_x)
                for column in range(left, right):
                    counts[chunk, row * tiles_x + column] += 1


@njit(cache=True)
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


@njit(parallel=True, cache=True, error_model="numpy")
def scatter_tiles(values, order, tiles_x, first_row, last_row, cursors, lists):
    """Write record indices of tile rows [first_row, last_row) to ``lists`` int32."""
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            index = np.int64(order[i] & np.uint64(0xFFFFFFFF))
            record = values[index]
            first, last = tile_rows(record, first_row, last_row)
            for row in range(first, last):
                left, right = tile_columns(record, row, tiles_x)
                for column in range(left, right):
                    tile = row * tiles_x + column
                    lists[cursors[chunk, tile]] = index
                    cursors[chunk, tile] += 1


@njit(inline="always", error_model="numpy")
def tile_rows(record, first_row, last_row):
    """Range of tile rows within [first_row, last_row) that the bounding box touches."""
    top = record[MEAN_Y] - record[EXTENT_Y] - SLACK
    bottom = record[MEAN_Y] + record[EXTENT_Y] + SLACK
    scale = F32(1.0 / TILE)
    first = max(np.int64(math.floor(max(top * scale, F32(-1)))), first_row)
    last = min(np.int64(math.floor(min(bottom * scale, F32(last_row)))) + 1, last_row)
    return first, last


@njit(inline="always", error_model="numpy")
def tile_columns(record, row, tiles_x):
    """Range of tile columns where the ellipse meets the pixel centres of a tile row."""
    y0 = F32(row * TILE) + F32(0.5) - record[MEAN_Y]
    y1 = y0 + F32(TILE - 1)
    right = side_reach(record, y0, y1, record[TIP_Y], F32(1))
    left = side_reach(record, y0, y1, -record[TIP_Y], F32(-1))
    scale = F32(1.0 / TILE)
    centre, half = record[MEAN_X], F32(0.5)
    first = math.floor(max((centre + left - half - SLACK) * scale, F32(0)))
    last = math.floor(min((centre + right - half + SLACK) * scale, F32(tiles_x - 1)))
    return np.int64(first), np.int64(last) + 1


@njit(inline="always", error_model="numpy")
def side_reach(record, y0, y1, tip, side):
    """Outermost dx of the ellipse on one side (``side`` = ±1) for dy in [y0, y1]."""
    dy = min(max(tip, y0), y1)
    dy = min(max(dy, -record[EXTENT_Y]), record[EXTENT_Y])
    room = max(LIMIT - record[LEVEL] - record[FALLOFF] * dy * dy, F32(0))
    return record[SLOPE] * dy + side * math.sqrt(room) / record[SHARPNESS]
