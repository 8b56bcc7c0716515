"""Which tiles a record may touch: a range of columns in each row of tiles.

A footprint is one int64: from the lowest bit on the tiles x0, x1, y0, y1 of the half-open box
around it, FIELD bits each, then one bit for each tile of a box of at most SMALL x SMALL tiles, row
by row. Such a footprint says everything by itself, so that dealing records to tiles does not need
the records, which do not fit a cache.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from .kernel import inlined
from .lanes import I64, LONGS, Integers, Lanes, Planes, mask_bits, mask_of
from .project_lanes import PROJECTION, Named
from .records import (
    EXPONENT_LIMIT,
    EXTENT_X,
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

F32 = np.float32
ZERO, HALF, ONE = F32(0), F32(0.5), F32(1)
LIMIT, PER_TILE = F32(EXPONENT_LIMIT), F32(1.0 / TILE)
SLACK = F32(0.01)
"""Boxes and ranges are widened by this [px] against rounding; the blending decides exactly."""
FIELD = 12
FIELD_MASK = (1 << FIELD) - 1
SMALL = 4
ROW_MASK = (1 << SMALL) - 1

LOWEST_BITS = np.uint64(sum((b & -b).bit_length() - 1 << 4 * b for b in range(1, 16)))
BIT_LENGTHS = np.uint64(sum(b.bit_length() << 4 * b for b in range(1, 16)))
"""Answers for the sixteen values of a row of bits, four bits each."""


@intrinsic
def footprints_of_eight(typingctx, planes, lanes, view, found):  # type: ignore[no-untyped-def]
    """Write the footprints of eight records to ``found`` [8] int64.

    Args:
        planes: see :mod:`.project_lanes`.
        lanes: bits of those that are in question.
        view: CameraParameters.

    Returns:
        Bits of those that may touch a tile.
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        data = context.make_array(planes)(context, builder, arguments[0]).data
        eight = Planes(builder, data, I64(0), planes=PROJECTION)
        named = Named(context, builder, view, arguments[2])
        footprints, remaining = _footprints(eight, named)
        target = context.make_array(found)(context, builder, arguments[3]).data
        builder.store(footprints.value, builder.bitcast(target, LONGS.as_pointer()), align=8)
        return mask_bits(builder, builder.and_(mask_of(builder, arguments[1]), remaining))

    return types.int64(planes, types.int64, view, found), generate


def _footprints(eight: Planes, view: Named) -> tuple[Integers, Any]:
    """Emit the footprints of eight records, and the mask of those that touch a tile."""
    x0, x1 = _tile_range(eight.load(MEAN_X), eight.load(EXTENT_X), view.number("width"))
    y0, y1 = _tile_range(eight.load(MEAN_Y), eight.load(EXTENT_Y), view.number("height"))
    columns, rows = x1 - x0, y1 - y0
    one, touched = (Integers.filled(eight.builder, number) for number in (1, 0))
    for row in range(SMALL):
        left, right = _row_columns(eight, y0 + row, (x0, x1))
        # A range of bits is a difference of powers of two.
        bits = (one << (right - x0)) - (one << (left - x0))
        here = eight.builder.and_(right.compare(">", left), rows.compare(">", row))
        touched = touched | (bits.where(here, 0) << row * SMALL)
    small = [n.compare(">", 1) for n in (columns, rows)]
    small += [n.compare("<=", SMALL) for n in (columns, rows)]
    touched = touched.where(reduce(eight.builder.and_, small), 0)
    across, down = x0 | (x1 << FIELD), y0 | (y1 << FIELD)
    footprints = across.longs() | (down.longs() << 2 * FIELD) | (touched.longs() << 4 * FIELD)
    there = eight.builder.and_(columns.compare(">", 0), rows.compare(">", 0))
    return footprints, there


def _tile_range(centre: Lanes, reach: Lanes, size: Lanes) -> tuple[Integers, Integers]:
    """Half-open range of the tiles with pixel centres within ``reach`` [px] of a centre."""
    first = (centre - (reach + SLACK) - 0.5).at_least(0.0)
    last = (centre + (reach + SLACK) - 0.5).at_most(size - 1.0)
    return (first * PER_TILE).floor().integers(), (last * PER_TILE).floor().integers() + 1


def _row_columns(
    eight: Planes, row: Integers, columns: tuple[Integers, Integers]
) -> tuple[Integers, Integers]:
    """Part of the tile columns where the ellipses meet pixel centres of a row of tiles."""
    first, last = columns
    top = row.floats() * TILE + 0.5 - eight.load(MEAN_Y)
    centre, tip = eight.load(MEAN_X) - 0.5, eight.load(TIP_Y)
    right = (centre + _side_reach(eight, top, tip, 1) + SLACK) * PER_TILE
    left = (centre + _side_reach(eight, top, -tip, -1) - SLACK) * PER_TILE
    left_column = left.at_least(first.floats()).floor().integers()
    right_column = right.at_most(last.floats()).floor().integers() + 1
    return left_column, right_column.where(right_column.compare("<", last), last)


def _side_reach(eight: Planes, top: Lanes, tip: Lanes, side: int) -> Lanes:
    """Outermost dx of the ellipses on one side (±1) within the row of tiles from ``top`` on."""
    reach = eight.load(EXTENT_Y)
    dy = tip.at_least(top).at_most(top + (TILE - 1)).at_least(-reach).at_most(reach)
    room = (-(dy * dy)).fused(eight.load(FALLOFF), -eight.load(LEVEL) + EXPONENT_LIMIT)
    half = room.at_least(0.0).root() / eight.load(SHARPNESS)
    return dy.fused(eight.load(SLOPE), half if side > 0 else -half)


@inlined()
def in_one_tile(footprint: Any) -> Any:
    """Whether the box around it is a single tile: nothing is left to ask of rows and columns."""
    columns = ((footprint >> FIELD) - footprint) & FIELD_MASK
    rows = ((footprint >> 3 * FIELD) - (footprint >> 2 * FIELD)) & FIELD_MASK
    return columns == 1 and rows == 1


@inlined()
def only_tile(footprint: Any, tiles_x: Any) -> Any:
    """Number of that tile."""
    return ((footprint >> 2 * FIELD) & FIELD_MASK) * tiles_x + (footprint & FIELD_MASK)


@inlined()
def tile_rows(footprint: Any) -> Any:
    """Range of tile rows."""
    return (footprint >> 2 * FIELD) & FIELD_MASK, (footprint >> 3 * FIELD) & FIELD_MASK


@inlined()
def tile_columns(values: Any, footprint: Any, index: Any, row: Any) -> Any:
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
def ellipse_columns(record: Any, row: Any, first: Any, last: Any) -> Any:
    """Part of the tile columns [first, last) where the ellipse meets pixel centres of a row."""
    y0 = F32(row * TILE) + HALF - record[MEAN_Y]
    y1 = y0 + F32(TILE - 1)
    centre = record[MEAN_X] - HALF
    right = (centre + side_reach(record, y0, y1, record[TIP_Y], ONE) + SLACK) * PER_TILE
    left = (centre + side_reach(record, y0, y1, -record[TIP_Y], -ONE) - SLACK) * PER_TILE
    first = max(first, np.int64(math.floor(max(left, ZERO))))
    return first, min(last, np.int64(math.floor(min(right, F32(last)))) + 1)


@inlined()
def side_reach(record: Any, y0: Any, y1: Any, tip: Any, side: Any) -> Any:
    """Outermost dx of the ellipse on one side (``side`` = ±1) for dy in [y0, y1]."""
    dy = min(max(tip, y0), y1)
    dy = min(max(dy, -record[EXTENT_Y]), record[EXTENT_Y])
    room = max(LIMIT - record[LEVEL] - record[FALLOFF] * dy * dy, ZERO)
    return record[SLOPE] * dy + side * math.sqrt(room) / record[SHARPNESS]
