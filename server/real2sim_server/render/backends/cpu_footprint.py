"""Which tiles a record may touch: a range of columns in each row of tiles.

A footprint is one int64: from the lowest bit on the tiles x0, x1, y0, y1 of the half-open box
around it, FIELD bits each, then one bit for each tile of a box of at most SMALL x SMALL tiles, row
by row. Such a footprint says everything by itself, so that dealing records to tiles does not need
the records, which do not fit a cache.
"""

from __future__ import annotations

import math

import numpy as np

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
from .kernel import inlined

F32 = np.float32
ZERO, HALF, ONE = F32(0), F32(0.5), F32(1)
LIMIT, PER_TILE = F32(EXPONENT_LIMIT), F32(1.0 / TILE)
SLACK = F32(0.01)
"""Boxes and ranges are widened by this [px] against rounding; the blending decides exactly."""
FIELD = 12
FIELD_MASK = (1 << FIELD) - 1
MAX_TILES = FIELD_MASK
"""Most tiles in a row or column of an image."""
SMALL = 4
ROW_MASK = (1 << SMALL) - 1
NOWHERE = np.int64(0)
"""Footprint of what cannot be seen; no other has this value since x1 and y1 are at least 1."""

LOWEST_BITS = np.uint64(sum((b & -b).bit_length() - 1 << 4 * b for b in range(1, 16)))
BIT_LENGTHS = np.uint64(sum(b.bit_length() << 4 * b for b in range(1, 16)))
"""Answers for the sixteen values of a row of bits, four bits each."""


@inlined()
def footprint_of(view, record, reach_x, reach_y):
    """Footprint of a record whose box reaches so far [px] from its centre; NOWHERE when none."""
    x, y = record[MEAN_X], record[MEAN_Y]
    reach_x, reach_y = reach_x + SLACK, reach_y + SLACK
    x0 = np.int64(math.floor(max(x - reach_x - HALF, ZERO) * PER_TILE))
    y0 = np.int64(math.floor(max(y - reach_y - HALF, ZERO) * PER_TILE))
    x1 = np.int64(math.floor(min(x + reach_x - HALF, view.width - ONE) * PER_TILE)) + 1
    y1 = np.int64(math.floor(min(y + reach_y - HALF, view.height - ONE) * PER_TILE)) + 1
    if x1 <= x0 or y1 <= y0:
        return NOWHERE
    box = x0 | x1 << FIELD | y0 << 2 * FIELD | y1 << 3 * FIELD
    if x1 - x0 == 1 or y1 - y0 == 1 or x1 - x0 > SMALL or y1 - y0 > SMALL:
        return box
    touched = np.int64(0)
    for row in range(y0, y1):
        left, right = ellipse_columns(record, row, x0, x1)
        for column in range(left, right):
            touched |= np.int64(1) << ((row - y0) * SMALL + column - x0)
    return box | touched << 4 * FIELD


@inlined()
def tile_rows(footprint):
    """Range of tile rows."""
    return (footprint >> 2 * FIELD) & FIELD_MASK, (footprint >> 3 * FIELD) & FIELD_MASK


@inlined()
def tile_columns(values, footprint, index, row):
    """Range of tile columns where record ``index`` may touch pixels of a row of tiles."""
    first, last = footprint & FIELD_MASK, (footprint >> FIELD) & FIELD_MASK
    top, bottom = tile_rows(footprint)
    if last - first == 1 or bottom - top == 1:
        return first, last
    if last - first > SMALL or bottom - top > SMALL:
        return ellipse_columns(values[index], row, first, last)
    bits = np.uint64(footprint >> (4 * FIELD + (row - top) * SMALL)) & np.uint64(ROW_MASK)
    place = bits << np.uint64(2)
    left = np.int64((LOWEST_BITS >> place) & np.uint64(15))
    return first + left, first + np.int64((BIT_LENGTHS >> place) & np.uint64(15))


@inlined()
def ellipse_columns(record, row, first, last):
    """Part of the tile columns [first, last) where the ellipse meets pixel centres of a row."""
    y0 = F32(row * TILE) + HALF - record[MEAN_Y]
    y1 = y0 + F32(TILE - 1)
    centre = record[MEAN_X] - HALF
    right = (centre + side_reach(record, y0, y1, record[TIP_Y], ONE) + SLACK) * PER_TILE
    left = (centre + side_reach(record, y0, y1, -record[TIP_Y], -ONE) - SLACK) * PER_TILE
    first = max(first, np.int64(math.floor(max(left, ZERO))))
    return first, min(last, np.int64(math.floor(min(right, F32(last)))) + 1)


@inlined()
def side_reach(record, y0, y1, tip, side):
    """Outermost dx of the ellipse on one side (``side`` = ±1) for dy in [y0, y1]."""
    dy = min(max(tip, y0), y1)
    dy = min(max(dy, -record[EXTENT_Y]), record[EXTENT_Y])
    room = max(LIMIT - record[LEVEL] - record[FALLOFF] * dy * dy, ZERO)
    return record[SLOPE] * dy + side * math.sqrt(room) / record[SHARPNESS]
