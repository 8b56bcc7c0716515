"""Blending of image tiles on the CPU: depth order, tile lists and blending.

Records are sorted by depth and listed for each 16x16 tile; tiles are then blended front to back.
All work is split in a fixed pattern, so results are bitwise independent of the number of threads.

The inner loop is explicit vector code over eight pixels. Their state is PLANES vectors:
transmittance (negative once finished), red, green, blue, depth, instance, median depth.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from ..._numba import PARALLEL_LOOPS
from ..backend import ALPHA_MAX, TRANSMITTANCE_MIN
from .lanes import (
    LANES,
    VECTOR,
    Lanes,
    Planes,
    inlined,
    kernel,
    lane_numbers,
    lowest_bit,
    prefetch,
    splat,
)
from .project import tile_columns, tile_rows
from .records import (
    BLUE,
    CHUNK,
    DEPTH,
    EXPONENT_LIMIT,
    EXPONENT_UNIT,
    FALLOFF,
    GREEN,
    INSTANCE,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    RED,
    SHARPNESS,
    SLOPE,
    TILE,
    Records,
)

PLANES = 7


def _exponential_coefficients(degree: int) -> list[float]:
    """Coefficients, constant first, of a polynomial approximation of exp(-u) on [0,
    EXPONENT_LIMIT].

    Interpolates at Chebyshev nodes. For degree 4, the error of the sixteenth power is 2e-6.
    """
    nodes = np.cos((2 * np.arange(degree + 1) + 1) / (2 * degree + 2) * np.pi)
    nodes = (nodes + 1) / 2 * EXPONENT_LIMIT
    return [float(c) for c in np.polynomial.polynomial.polyfit(nodes, np.exp(-nodes), degree)]


EXPONENTIAL = _exponential_coefficients(4)
SQUARINGS = int(np.log2(EXPONENT_UNIT))


def exponential(exponent: Lanes) -> Lanes:
    """exp(-EXPONENT_UNIT exponent)."""
    power = Lanes(exponent.builder, ir.Constant(VECTOR, [EXPONENTIAL[-1]] * LANES))
    for coefficient in EXPONENTIAL[-2::-1]:
        power = power.fused(exponent, coefficient)
    for _ in range(SQUARINGS):
        power = power * power
    return power


def _build_blend(builder: ir.IRBuilder, state: Planes, scalars: list[Any], extras: int) -> Any:
    """Emit the blending of one record; returns eight bits, set for unfinished pixels."""
    sharpness, offset, rest, *values = (splat(builder, scalar) for scalar in scalars)
    distance = (lane_numbers(builder) + offset) * sharpness
    return blend_exponent(builder, state, distance.fused(distance, rest), values, extras)


def blend_exponent(
    builder: ir.IRBuilder, state: Planes, exponent: Lanes, values: list[Lanes], extras: int
) -> Any:
    """Emit the blending of one record whose alpha is exp(-EXPONENT_UNIT exponent).

    Args:
        builder: IR builder of the kernel.
        state: eight pixels.
        exponent: exponents at these pixels; NaN or above EXPONENT_LIMIT contributes nothing.
        values: red, green, blue, depth, instance.
        extras: see _blend_intrinsic.

    Returns:
        Eight bits, set for unfinished pixels.
    """
    alpha = exponential(exponent)
    alpha = alpha.where(alpha.compare("<", ALPHA_MAX), ALPHA_MAX)

    before = state.load(0)
    weight = alpha * before
    after = before - weight
    touched = exponent.compare("<=", EXPONENT_LIMIT)
    goes_on = after.compare(">", TRANSMITTANCE_MIN)
    blended = builder.and_(touched, goes_on)
    finished = builder.and_(touched, builder.not_(goes_on))
    # Sums and sign bits instead of a select: LLVM would emit a masked store, which is slow on many
    # processors.
    weight = weight.where(blended, 0.0)
    new = (before - weight).negative_where(finished)
    state.store(0, new)
    for plane, value in enumerate(values[: 3 + (extras & 1)], start=1):
        state.store(plane, weight.fused(value, state.load(plane)))
    if extras & 2:
        halving = builder.and_(before.compare(">", 0.5), after.compare("<=", 0.5))
        crossing = builder.and_(blended, halving)
        state.store(5, state.load(5) + values[-1].where(crossing, 0.0))
        if extras & 4:
            state.store(6, state.load(6) + values[3].where(crossing, 0.0))
    mask = builder.bitcast(new.compare(">", 0.0), ir.IntType(LANES))
    return builder.zext(mask, ir.IntType(64))


def _blend_intrinsic(extras: int) -> Any:
    """The intrinsic for RGB (0), with depth (+1), with instance (+2), with median depth (+4).

    In kernels: blend(pixels, half, sharpness, offset, rest, red, green, blue, depth, instance)
    with exponent = (sharpness (lane + offset))^2 + rest; returns 0 when all pixels are finished.
    """

    def blend(typingctx, pixels, half, sharpness, offset, rest, red, green, blue, depth, instance):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            state = Planes(builder, array.data, arguments[1], planes=PLANES)
            return _build_blend(builder, state, list(arguments[2:]), extras)

        floats = (types.float32,) * 8
        return types.int64(pixels, types.int64, *floats), generate

    return intrinsic(blend)


blend_rgb = _blend_intrinsic(0)
blend_rgb_depth = _blend_intrinsic(1)
blend_rgb_depth_instance = _blend_intrinsic(3)
blend_all = _blend_intrinsic(7)


@intrinsic
def touched_halves(typingctx, x, y, sharpness, slope, falloff, level):
    """Bits of the half rows of a 16x16 tile that one record may touch: 16 left ones, 16 right.

    ``x``, ``y`` is the first pixel centre of the tile relative to the record's centre [px].
    """

    def generate(context, builder, signature, arguments):
        x, y, sharpness, slope, falloff, level = (splat(builder, value) for value in arguments)
        numbers = lane_numbers(builder)
        i64 = ir.IntType(64)
        touched = i64(0)
        for first_row in (0, LANES):
            dy = numbers + y + float(first_row)
            rest = (dy * dy).fused(falloff, level)
            left = x - slope * dy
            for side in (0, 1):
                start = left + float(side * LANES)
                beyond = -start - float(LANES - 1)
                gap = start.where(start.compare(">", beyond), beyond)
                gap = gap.where(gap.compare(">", 0.0), 0.0) * sharpness
                mask = gap.fused(gap, rest).compare("<=", EXPONENT_LIMIT)
                bits = builder.zext(builder.bitcast(mask, ir.IntType(LANES)), i64)
                shift = i64(side * 2 * LANES + first_row)
                touched = builder.or_(touched, builder.shl(bits, shift))
        return touched

    return types.int64(*(types.float32,) * 6), generate


# Front-to-back blending


TASKS = 64
"""Number of tasks. Tiles are assigned round-robin, which spreads dense parts of an image."""
LOOK_AHEAD = 6
HALVES = TILE // LANES
F32 = np.float32
HALF = F32(0.5)


@kernel(parallel=PARALLEL_LOOPS)
def blend_tiles(values, lists, starts, tiles_x, first_tile, last_tile, background, images):
    """Blend tiles [first_tile, last_tile) into Images.

    Args:
        values: [M, RECORD] float32.
        lists: record indices by tile, near to far.
        starts: [tiles + 1] int64, start of each tile's list.
        background: [3] float32.
    """
    extras = (1 if images.depth.shape[0] else 0) + (2 if images.instance.shape[0] else 0)
    extras += 4 if images.median.shape[0] else 0
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    rgb, alpha, depth, instance = images.rgb, images.alpha, images.depth, images.instance
    median = images.median
    for task in prange(TASKS):
        pixels = np.empty(TILE * HALVES * PLANES * LANES, np.float32)
        for tile in range(first_tile + task, last_tile, TASKS):
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            going = open_tile(pixels, PLANES, x0, y0, alpha.shape)
            first, last = starts[tile], starts[tile + 1]
            blend_tile(values, lists, first, last, F32(x0), F32(y0), pixels, going, extras)
            write_tile(pixels, x0, y0, background, rgb, alpha, depth, instance, median)


@inlined()
def open_tile(pixels, planes, x0, y0, shape):
    """Clear the state and finish pixels outside the image.

    Half rows of eight pixels are numbered down the left half of the tile, then down the right half.
    Each has ``planes`` vectors, the first of which is its transmittance.
    Returns a bit per half row, set if it has unfinished pixels.
    """
    pixels[:] = 0
    alive = np.int64(0)
    for row in range(min(TILE, shape[0] - y0)):
        for column in range(min(TILE, shape[1] - x0)):
            half = column // LANES * TILE + row
            pixels[half * planes * LANES + column % LANES] = 1
            alive |= np.int64(1) << half
    return alive


@inlined()
def blend_tile(values, lists, first, last, x0, y0, pixels, alive, extras):
    """Blend lists[first:last], near to far, until all pixels are finished."""
    for position in range(first, last):
        prefetch(values, np.int64(lists[min(position + LOOK_AHEAD, last - 1)]))
        record = values[lists[position]]
        x, y = x0 + HALF - record[MEAN_X], y0 + HALF - record[MEAN_Y]
        sharpness, slope = record[SHARPNESS], record[SLOPE]
        falloff, level = record[FALLOFF], record[LEVEL]
        touched = touched_halves(x, y, sharpness, slope, falloff, level) & alive
        while touched != 0:
            half = lowest_bit(touched)
            touched &= touched - 1
            dy = y + F32(half % TILE)
            start = x - slope * dy + F32(half // TILE * LANES)
            rest = falloff * dy * dy + level
            going = blend_half(pixels, half, record, start, rest, extras)
            alive &= ~(np.int64(going == 0) << half)
        if alive == 0:
            break


@inlined()
def blend_half(pixels, half, record, start, rest, extras):
    """Blend one record over eight pixels; returns 0 when all of them are finished."""
    sharpness, depth, instance = record[SHARPNESS], record[DEPTH], record[INSTANCE]
    red, green, blue = record[RED], record[GREEN], record[BLUE]
    if extras >= 4:
        return blend_all(pixels, half, sharpness, start, rest, red, green, blue, depth, instance)
    if extras >= 2:
        return blend_rgb_depth_instance(
            pixels, half, sharpness, start, rest, red, green, blue, depth, instance
        )
    if extras == 1:
        return blend_rgb_depth(
            pixels, half, sharpness, start, rest, red, green, blue, depth, instance
        )
    return blend_rgb(pixels, half, sharpness, start, rest, red, green, blue, depth, instance)


@inlined()
def write_tile(pixels, x0, y0, background, rgb, alpha, depth, instance, median):
    """Composite the tile over the background and write it to the images."""
    height, width = alpha.shape
    for row in range(min(TILE, height - y0)):
        for column in range(min(TILE, width - x0)):
            p = (column // LANES * TILE + row) * PLANES * LANES + column % LANES
            y, x = y0 + row, x0 + column
            left = abs(pixels[p])
            alpha[y, x] = F32(1) - left
            for channel in range(3):
                seen = pixels[p + (1 + channel) * LANES]
                rgb[y, x, channel] = seen + left * background[channel]
            if depth.shape[0]:
                total = F32(1) - left
                depth[y, x] = pixels[p + 4 * LANES] / total if total > 0 else F32(0)
            if instance.shape[0]:
                instance[y, x] = np.uint16(pixels[p + 5 * LANES])
            if median.shape[0]:
                median[y, x] = pixels[p + 6 * LANES]


# Tile lists: records are counted in depth order, then scattered by chunk, each with its cursors.


TILE_CHUNKS = 8
SPLATS_AHEAD = 24
LOW_BITS = np.uint64(0xFFFFFFFF)


@kernel(parallel=PARALLEL_LOOPS)
def count_tiles(values, footprints, order, tiles_x, ordered_footprints, counts):
    """Count the records of each chunk in each tile.

    Args:
        values, footprints: see Records.
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
            prefetch(footprints, np.int64(order[min(i + SPLATS_AHEAD, total - 1)] & LOW_BITS))
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
    """Convert counts of tiles [first_tile, last_tile) to cursors per chunk and tile starts."""
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


# Depth order: a stable LSD radix sort; ties keep the order of instances and of their Gaussians.

DIGIT_BITS = 11
SORT_CHUNKS = 8
Pairs = NDArray[np.uint64]


def sort_records(records: Records, regions: int, pairs: Pairs, scratch: Pairs) -> Pairs:
    """Depth order of the records in the first ``regions`` regions.

    Args:
        pairs, scratch: [M] uint64 work space, M at least the number of used records.

    Returns:
        View of one of the two arrays: record indices in the low 32 bits, near to far.
    """
    ends = np.cumsum(records.counts[:regions])
    total = int(ends[-1]) if regions else 0
    if total == 0:
        return pairs[:0]
    low, high = gather_pairs(records.depths.view(np.uint32), records.counts, ends, pairs)
    bits = int(high - low).bit_length()
    passes = -(-bits // DIGIT_BITS)
    for index in range(passes):
        width = -(-bits // passes)
        radix_pass(pairs, scratch, total, 32 + index * width, width)
        pairs, scratch = scratch, pairs
    return pairs[:total]


@kernel(parallel=PARALLEL_LOOPS)
def gather_pairs(keys, counts, ends, pairs):
    """Pack (key - smallest key) and record index; return the smallest and largest key.

    Keys are the bits of the depths. Depths are positive, so their bits sort like them.
    """
    lows = np.full(ends.shape[0], 0xFFFFFFFF, np.uint32)
    highs = np.zeros(ends.shape[0], np.uint32)
    for region in prange(ends.shape[0]):
        for i in range(region * CHUNK, region * CHUNK + counts[region]):
            lows[region] = min(lows[region], keys[i])
            highs[region] = max(highs[region], keys[i])
    low, high = np.uint32(0xFFFFFFFF), np.uint32(0)
    for region in range(ends.shape[0]):
        low, high = min(low, lows[region]), max(high, highs[region])
    for region in prange(ends.shape[0]):
        target = ends[region] - counts[region]
        for i in range(counts[region]):
            index = region * CHUNK + i
            pairs[target + i] = (np.uint64(keys[index] - low) << np.uint64(32)) | np.uint64(index)
    return np.int64(low), np.int64(high)


@kernel(parallel=PARALLEL_LOOPS)
def radix_pass(source, target, total, shift, width):
    """Stable counting sort of ``source[:total]`` by ``width`` bits starting at bit ``shift``."""
    size = 1 << width
    mask, low = np.uint64(size - 1), np.uint64(shift)
    step = (total + SORT_CHUNKS - 1) // SORT_CHUNKS
    cursor = np.zeros((SORT_CHUNKS, size), np.int64)
    for chunk in prange(SORT_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            cursor[chunk, (source[i] >> low) & mask] += 1
    position = 0
    for digit in range(size):
        for chunk in range(SORT_CHUNKS):
            count = cursor[chunk, digit]
            cursor[chunk, digit] = position
            position += count
    for chunk in prange(SORT_CHUNKS):
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            digit = (source[i] >> low) & mask
            target[cursor[chunk, digit]] = source[i]
            cursor[chunk, digit] += 1
