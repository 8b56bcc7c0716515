"""Backward blending: from the loss gradients of pixels to the gradients of records.

The backward pass traverses the Gaussians front to back and repeats the forward arithmetic bit for
bit, so it stops at the same Gaussians without stored state. Let v be colour, depth and 1 weighted
by the loss gradient of a pixel. The pixel's share of the loss is the sum of w v over its Gaussians.
``REST`` is the remaining part of this sum. The gradient with respect to alpha is
T v - REST / (1 - alpha).

The inner loop is explicit vector code for one record over one tile. It accumulates gradients with
respect to the exponent as moments about the centre of the tile, per lane over the rows, and sums
the lanes at the end. Each entry of a tile list has a separate output slot, so results are bitwise
independent of the number of threads.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from ..._numba import PARALLEL_LOOPS
from ..backend import ALPHA_MAX, TRANSMITTANCE_MIN
from .blend import HALF, LOOK_AHEAD, TASKS, exponential, touched_halves
from .lanes import (
    FLOAT,
    LANES,
    VECTOR,
    Lanes,
    Planes,
    inlined,
    kernel,
    lane_numbers,
    prefetch,
    splat,
)
from .records import (
    BLUE,
    DEPTH,
    EXPONENT_LIMIT,
    FALLOFF,
    GREEN,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    RED,
    SHARPNESS,
    SLOPE,
    TILE,
)

LEFT, REST, BY_RED, BY_GREEN, BY_BLUE, BY_DEPTH, BY_ALPHA = range(7)
"""Planes of eight pixels: transmittance (negative once finished), the remaining sum of w v, and the
loss gradients with respect to the sums of w times red, green, blue, depth and 1."""
BACKWARD_PLANES = 7

SUM_1, SUM_X, SUM_XX, SUM_Y, SUM_XY, SUM_YY, ABS_X, ABS_Y = range(8)
"""Sums over pixels of dL/dalpha alpha times powers of x and y from the centre of the tile [px].

The last two are sums of its absolute value times |dx'| and |sharpness^2 slope dx' - falloff dy|,
where dx' = dx - slope dy.
"""
SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH = range(8, 12)
"""Loss gradients with respect to the record's colour and depth."""
SUMS = 16

I64 = ir.IntType(64)
MIDDLE = (TILE - 1) / 2
Vectors = list[Lanes]


@dataclass(frozen=True, eq=False)
class _Splat:
    """Scalars of one record and the vectors derived from them."""

    x: Any
    y: Any
    slope: Any
    falloff: Any
    level: Any
    sharpness: Lanes
    steepness: Lanes
    values: Vectors


@intrinsic
def blend_backward(
    typingctx,
    pixels,
    tile,
    touched,
    x,
    y,
    sharpness,
    slope,
    falloff,
    level,
    red,
    green,
    blue,
    depth,
    sums,
):
    """Accumulate the gradients of one record over the half rows ``touched`` of a tile.

    Args:
        pixels: float32 state, BACKWARD_PLANES vectors for each of the 32 half rows of each tile.
        tile: index of the tile in ``pixels``.
        touched: bit per half row: 16 left ones, then 16 right ones.
        x, y: the tile's first pixel centre relative to the record's centre [px].
        sharpness, slope, falloff, level, red, green, blue, depth: fields of the record.
        sums: [SUMS] float32, written.

    Returns:
        Bits of the half rows whose pixels are all finished.
    """

    def generate(context, builder, signature, arguments):
        first, last = signature.args[0], signature.args[-1]
        data = context.make_array(first)(context, builder, arguments[0]).data
        target = context.make_array(last)(context, builder, arguments[-1]).data
        tile, touched, *scalars = arguments[1:-1]
        return _build(builder, data, tile, touched, _splat_of(builder, scalars), target)

    kinds = (types.int64, types.int64, *(types.float32,) * 10)
    return types.int64(pixels, *kinds, sums), generate


def _splat_of(builder: ir.IRBuilder, scalars: list[Any]) -> _Splat:
    x, y, sharpness, slope, falloff, level, *values = scalars
    steepness = builder.fmul(builder.fmul(sharpness, sharpness), slope)
    return _Splat(
        x=x,
        y=y,
        slope=slope,
        falloff=falloff,
        level=level,
        sharpness=splat(builder, sharpness),
        steepness=splat(builder, steepness),
        values=[splat(builder, value) for value in values],
    )


def _build(
    builder: ir.IRBuilder, data: Any, tile: Any, touched: Any, record: _Splat, target: Any
) -> Any:
    """Emit both halves of the tile, the sums over lanes, and the mask of finished half rows."""
    first_half = builder.mul(tile, I64(2 * TILE))
    finished = cgutils.alloca_once_value(builder, I64(0))
    moments = [_zero(builder) for _ in range(6)]
    rest = [_Variable(builder) for _ in range(6)]
    for side in (0, 1):
        mask = builder.and_(builder.lshr(touched, I64(side * TILE)), I64(2**TILE - 1))
        columns = [_Variable(builder) for _ in range(3)]

        def row_step(row: Any, side: int = side, columns: Any = columns) -> None:
            half = builder.add(row, I64(side * TILE))
            state = Planes(builder, data, builder.add(first_half, half), planes=BACKWARD_PLANES)
            done = _build_half(builder, state, record, row, side, columns, rest)
            bit = builder.shl(builder.zext(done, I64), half)
            builder.store(builder.or_(builder.load(finished, typ=I64), bit), finished)

        _for_each_bit(builder, mask, row_step)
        x = Lanes(builder, ir.Constant(VECTOR, [side * LANES + i - MIDDLE for i in range(LANES)]))
        by_row = [column.load() for column in columns]
        weighted = (
            by_row[0],
            by_row[0] * x,
            by_row[0] * x * x,
            by_row[1],
            by_row[1] * x,
            by_row[2],
        )
        moments = [moment + part for moment, part in zip(moments, weighted, strict=True)]
    others = [variable.load() for variable in rest]
    zero = _zero(builder)
    for index, eight in enumerate(([*moments, *others[:2]], [*others[2:], zero, zero, zero, zero])):
        place = builder.gep(target, [I64(index * LANES)], source_etype=FLOAT)
        total = _sum_lanes(builder, eight).value
        builder.store(total, builder.bitcast(place, VECTOR.as_pointer()), align=4)
    return builder.load(finished, typ=I64)


class _Variable:
    """A vector updated in a loop; LLVM promotes it to a register."""

    def __init__(self, builder: ir.IRBuilder) -> None:
        self.builder = builder
        self.place = cgutils.alloca_once(builder, VECTOR)
        builder.store(ir.Constant(VECTOR, [0.0] * LANES), self.place)

    def load(self) -> Lanes:
        return Lanes(self.builder, self.builder.load(self.place, typ=VECTOR))

    def add(self, lanes: Lanes) -> None:
        self.builder.store((self.load() + lanes).value, self.place)

    def add_product(self, left: Lanes, right: Lanes) -> None:
        self.builder.store(left.fused(right, self.load()).value, self.place)


def _zero(builder: ir.IRBuilder) -> Lanes:
    return Lanes(builder, ir.Constant(VECTOR, [0.0] * LANES))


def _for_each_bit(builder: ir.IRBuilder, mask: Any, body: Callable[[Any], None]) -> None:
    """Emit a loop over the positions of the set bits, from the lowest."""
    left = cgutils.alloca_once_value(builder, mask)
    test = builder.append_basic_block("bits.test")
    step = builder.append_basic_block("bits.step")
    end = builder.append_basic_block("bits.end")
    builder.branch(test)
    builder.position_at_end(test)
    bits = builder.load(left, typ=I64)
    builder.cbranch(builder.icmp_unsigned("!=", bits, I64(0)), step, end)
    builder.position_at_end(step)
    builder.store(builder.and_(bits, builder.sub(bits, I64(1))), left)
    body(builder.cttz(bits, ir.IntType(1)(1)))
    builder.branch(test)
    builder.position_at_end(end)


def _build_half(
    builder: ir.IRBuilder,
    state: Planes,
    record: _Splat,
    row: Any,
    side: int,
    columns: list[_Variable],
    rest: list[_Variable],
) -> Any:
    """Emit eight pixels; returns a bit, set if all of them are finished.

    ``columns`` accumulates the gradient times 1, y, y^2. ``rest`` accumulates the absolute
    gradients, then colour and depth.
    """
    row_number = builder.uitofp(row, FLOAT)
    dy = builder.fadd(record.y, row_number)
    start = builder.fsub(record.x, builder.fmul(record.slope, dy))
    if side:
        start = builder.fadd(start, ir.Constant(FLOAT, float(LANES)))
    bend = builder.fmul(record.falloff, dy)
    level = builder.fadd(builder.fmul(bend, dy), record.level)

    across = lane_numbers(builder) + splat(builder, start)
    scaled = across * record.sharpness
    exponent = scaled.fused(scaled, splat(builder, level))
    alpha = exponential(exponent)
    below_limit = alpha.compare("<", ALPHA_MAX)
    alpha = alpha.where(below_limit, ALPHA_MAX)

    before = state.load(LEFT)
    weight = alpha * before
    goes_on = (before - weight).compare(">", TRANSMITTANCE_MIN)
    touched = exponent.compare("<=", EXPONENT_LIMIT)
    blended = builder.and_(touched, goes_on)
    finished = builder.and_(touched, builder.not_(goes_on))
    weight = weight.where(blended, 0.0)
    new = (before - weight).negative_where(finished)
    state.store(LEFT, new)

    by_values = [state.load(plane) for plane in (BY_RED, BY_GREEN, BY_BLUE, BY_DEPTH)]
    value = state.load(BY_ALPHA)
    for own, by_value in zip(record.values, by_values, strict=True):
        value = own.fused(by_value, value)
    to_come = state.load(REST) - weight * value
    state.store(REST, to_come)
    for variable, by_value in zip(rest[2:], by_values, strict=True):
        variable.add_product(weight, by_value)

    one = Lanes(builder, ir.Constant(VECTOR, [1.0] * LANES))
    by_alpha = before * value - to_come / (one - alpha)
    moved = (by_alpha * alpha).where(builder.and_(blended, below_limit), 0.0)
    y = splat(builder, builder.fsub(row_number, ir.Constant(FLOAT, MIDDLE)))
    columns[0].add(moved)
    moved_y = moved * y
    columns[1].add(moved_y)
    columns[2].add_product(moved_y, y)
    rest[0].add((moved * across).magnitude())
    down = record.steepness * across - splat(builder, bend)
    rest[1].add((moved * down).magnitude())
    mask = builder.bitcast(new.compare(">", 0.0), ir.IntType(LANES))
    return builder.icmp_unsigned("==", mask, ir.IntType(LANES)(0))


def _sum_lanes(builder: ir.IRBuilder, eight: Vectors) -> Lanes:
    """Sums over the lanes of eight vectors, as one vector."""

    def fold(left: Lanes, right: Lanes, first: list[int], second: list[int]) -> Lanes:
        def pick(order: list[int]) -> Lanes:
            mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), order)
            return Lanes(builder, builder.shuffle_vector(left.value, right.value, mask))

        return pick(first) + pick(second)

    steps = (
        ([0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15]),
        ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]),
        ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]),
    )
    for first, second in steps:
        pairs = zip(eight[::2], eight[1::2], strict=True)
        eight = [fold(left, right, first, second) for left, right in pairs]
    return eight[0]


# Backward blending of tiles


F32 = np.float32
ZERO = F32(0)
ONE = F32(1)
TWO = F32(2)
CENTRE = F32(MIDDLE)
HALVES = 2 * TILE
SLOT = 12
"""float32 values of a slot: the sums SUM_1 to SUM_DEPTH, with x = dx - slope dy and y = dy relative
to the record's centre."""


class Losses(NamedTuple):
    """Loss gradients of the images of one camera; [0, 0] (rgb: [0, 0, 0]) if absent."""

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]


@kernel(parallel=PARALLEL_LOOPS)
def open_pixels(images, losses, behind, tiles_x, pixels):
    """Write the initial state of the backward pass.

    With A the accumulated opacity and g the loss gradients, the loss changes by g_rgb · d(sum w c)
    + g_depth / A · d(sum w z) + (g_alpha - g_rgb · behind - g_depth depth / A) · d(sum w).

    Args:
        images: Images of the forward pass, after the sky.
        losses: Losses.
        behind: [H, W, 3] float32 colour behind everything; [1, 1, 3] if constant.
        tiles_x: tiles in a row of the image.
        pixels: [tiles * HALVES * BACKWARD_PLANES * LANES] float32, written.
    """
    height, width = images.alpha.shape
    tiles = tiles_x * ((height + TILE - 1) // TILE)
    for tile in prange(tiles):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        base = tile * HALVES * BACKWARD_PLANES * LANES
        if x0 + TILE > width or y0 + TILE > height:
            pixels[base : base + HALVES * BACKWARD_PLANES * LANES] = ZERO
        for row in range(min(TILE, height - y0)):
            for column in range(min(TILE, width - x0)):
                half = column // LANES * TILE + row
                place = base + half * BACKWARD_PLANES * LANES + column % LANES
                open_pixel(images, losses, behind, y0 + row, x0 + column, pixels, place)


@inlined()
def open_pixel(images, losses, behind, y, x, pixels, place):
    """Write the initial state of one pixel."""
    total = images.alpha[y, x]
    by_alpha = losses.alpha[y, x] if losses.alpha.shape[0] else ZERO
    rest = total * by_alpha
    if losses.rgb.shape[0]:
        row, column = min(y, behind.shape[0] - 1), min(x, behind.shape[1] - 1)
        for k in range(3):
            by_color = losses.rgb[y, x, k]
            rest += by_color * (images.rgb[y, x, k] - behind[row, column, k])
            by_alpha -= by_color * behind[row, column, k]
            pixels[place + (BY_RED + k) * LANES] = by_color
    else:
        for k in range(3):
            pixels[place + (BY_RED + k) * LANES] = ZERO
    by_depth = ZERO
    if losses.depth.shape[0] and total > ZERO:
        by_depth = losses.depth[y, x] / total
        by_alpha -= by_depth * images.depth[y, x]
    pixels[place + LEFT * LANES] = ONE
    pixels[place + REST * LANES] = rest
    pixels[place + BY_DEPTH * LANES] = by_depth
    pixels[place + BY_ALPHA * LANES] = by_alpha


@kernel(parallel=PARALLEL_LOOPS)
def blend_tiles_backward(values, lists, slots, starts, tiles_x, shape, pixels, gradients, used):
    """Traverse all tiles and write the gradients of each record in each tile to its slot.

    Args:
        values: [M, RECORD] float32.
        lists, slots: [L] int32, record and slot of each entry, by tile, near to far.
        starts: [tiles + 1] int64, start of each tile's list.
        tiles_x: tiles in a row of the image.
        shape: height and width of the image [px].
        pixels: state from open_pixels; overwritten.
        gradients: [L, SLOT] float32, written for records that touch a pixel.
        used: [L] uint8, written: whether the record touches a pixel.
    """
    height, width = shape
    for task in prange(TASKS):
        sums = np.empty(SUMS, np.float32)
        for tile in range(task, starts.shape[0] - 1, TASKS):
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            alive = halves_inside(height - y0, width - x0)
            first, last = starts[tile], starts[tile + 1]
            position = first
            while position < last and alive != 0:
                prefetch(values, np.int64(lists[min(position + LOOK_AHEAD, last - 1)]))
                record, slot = values[lists[position]], slots[position]
                x, y = F32(x0) + HALF - record[MEAN_X], F32(y0) + HALF - record[MEAN_Y]
                touched = alive & touched_halves(
                    x, y, record[SHARPNESS], record[SLOPE], record[FALLOFF], record[LEVEL]
                )
                used[slot] = touched != 0
                if touched != 0:
                    alive &= ~walk(pixels, tile, touched, x, y, record, sums)
                    write_slot(sums, x, y, record[SLOPE], gradients[slot])
                position += 1
            for left in range(position, last):
                used[slots[left]] = 0


@inlined()
def halves_inside(rows, columns):
    """Bits of the half rows with a pixel inside the image."""
    bits = (np.int64(1) << min(rows, TILE)) - 1
    return bits | bits << TILE if columns > LANES else bits


@inlined()
def walk(pixels, tile, touched, x, y, record, sums):
    """Accumulate one record over one tile; see blend_backward."""
    return blend_backward(
        pixels,
        tile,
        touched,
        x,
        y,
        record[SHARPNESS],
        record[SLOPE],
        record[FALLOFF],
        record[LEVEL],
        record[RED],
        record[GREEN],
        record[BLUE],
        record[DEPTH],
        sums,
    )


@inlined()
def write_slot(sums, x, y, slope, out):
    """Write the moments, shifted from the tile's centre to the record's centre and axes."""
    down = y + CENTRE
    across = x + CENTRE - slope * down
    one, by_x, by_y = sums[SUM_1], sums[SUM_X], sums[SUM_Y]
    xx, xy, yy = sums[SUM_XX], sums[SUM_XY], sums[SUM_YY]
    tilted = by_x - slope * by_y
    out[SUM_1] = one
    out[SUM_X] = tilted + across * one
    out[SUM_Y] = by_y + down * one
    out[SUM_XX] = (
        xx - TWO * slope * xy + slope * slope * yy + across * (TWO * tilted + across * one)
    )
    out[SUM_XY] = xy - slope * yy + across * by_y + down * out[SUM_X]
    out[SUM_YY] = yy + down * (TWO * by_y + down * one)
    out[ABS_X], out[ABS_Y] = sums[ABS_X], sums[ABS_Y]
    out[SUM_RED], out[SUM_GREEN] = sums[SUM_RED], sums[SUM_GREEN]
    out[SUM_BLUE], out[SUM_DEPTH] = sums[SUM_BLUE], sums[SUM_DEPTH]
