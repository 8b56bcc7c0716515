"""The innermost step of blending as explicit vector code: one record over eight pixels.

State of eight pixels is PLANES vectors in a row: transmittance (negative once finished), red,
green, blue, depth, instance, median depth.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ..base import ALPHA_MAX, TRANSMITTANCE_MIN
from .lanes import LANES, VECTOR, Lanes, Planes, lane_numbers, splat
from .records import EXPONENT_LIMIT, EXPONENT_UNIT

PLANES = 7


def _exponential_coefficients(degree: int) -> list[float]:
    """Coefficients, constant first, of a polynomial near exp(-u) on [0, EXPONENT_LIMIT].

    Interpolates at Chebyshev nodes; with degree 4 the sixteenth power is right to 2e-6.
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
    """Emit the blending of one record; returns eight bits, set where a pixel goes on."""
    sharpness, offset, rest, *values = (splat(builder, scalar) for scalar in scalars)
    distance = (lane_numbers(builder) + offset) * sharpness
    return blend_exponent(builder, state, distance.fused(distance, rest), values, extras)


def blend_exponent(
    builder: ir.IRBuilder, state: Planes, exponent: Lanes, values: list[Lanes], extras: int
) -> Any:
    """Emit the blending of one record whose alpha is exp(-EXPONENT_UNIT exponent).

    Args:
        builder: of the kernel.
        state: of eight pixels.
        exponent: of these pixels; NaN or above EXPONENT_LIMIT where it shows nothing.
        values: red, green, blue, depth, instance.
        extras: see _blend_intrinsic.

    Returns:
        Eight bits, set where a pixel goes on.
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
    # Sums and sign bits, since a choice between old and new value would become a masked store,
    # which is slow on many processors.
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
    with exponent = (sharpness (lane + offset))^2 + rest; returns zero when all are finished.
    """

    def blend(  # type: ignore[no-untyped-def]
        typingctx, pixels, half, sharpness, offset, rest, red, green, blue, depth, instance
    ):
        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
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
def touched_halves(  # type: ignore[no-untyped-def]
    typingctx, x, y, sharpness, slope, falloff, level
):
    """Bits of the half rows of a 16x16 tile that one record may touch: 16 left ones, 16 right.

    ``x``, ``y`` is the first pixel centre of the tile as seen from the record's centre [px].
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
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


@intrinsic
def lowest_bit(typingctx, mask):  # type: ignore[no-untyped-def]
    """Position of the lowest bit that is set; ``mask`` int64, not 0."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.cttz(arguments[0], ir.IntType(1)(1))

    return types.int64(types.int64), generate


@intrinsic
def prefetch(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Ask for the cache line of ``array[index]`` (its first axis) without waiting for it."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        values = context.make_array(signature.args[0])(context, builder, arguments[0])
        stride = cgutils.unpack_tuple(builder, values.strides)[0]
        start = builder.bitcast(values.data, ir.IntType(8).as_pointer())
        offset = builder.mul(arguments[1], stride)
        pointer = builder.gep(start, [offset], source_etype=ir.IntType(8))
        i32 = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate
