"""The innermost steps of blending labels as vector code: one record over eight pixels.

Colours come of the very operations of :mod:`.simd`: their bits are those of a picture alone.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ..base import ALPHA_MAX, TRANSMITTANCE_MIN
from .lanes import LANES, Lanes, Planes, lane_numbers, splat
from .records import EXPONENT_LIMIT
from .simd import exponential

LABEL_PLANES = 5
"""Transmittance (negative once finished), red, green, blue, and the front: one more than the number
of the record that brings the transmittance to the asked level or below; where none does, of the one
that brings it to a half, 0 where none does that either."""
OWN_PLANES = 2
"""Transmittance and front of what an object shows by itself."""


def _alpha(builder: ir.IRBuilder, scalars: list[Any]) -> tuple[Lanes, Any]:
    """Alpha of one record, and the mask of pixels that it touches; sharpness, offset and rest."""
    sharpness, offset, rest = (splat(builder, scalar) for scalar in scalars)
    distance = (lane_numbers(builder) + offset) * sharpness
    exponent = distance.fused(distance, rest)
    alpha = exponential(exponent)
    alpha = alpha.where(alpha.compare("<", ALPHA_MAX), ALPHA_MAX)
    return alpha, exponent.compare("<=", EXPONENT_LIMIT)


def _blend(
    builder: ir.IRBuilder,
    state: Planes,
    seen: tuple[Lanes, Any],
    colours: list[Any],
    asked: list[Any],
) -> Any:
    """Emit the blending of one record; returns eight bits, set where a pixel goes on.

    Args:
        builder: of the kernel.
        state: of eight pixels; the front is the plane after the colours.
        seen: alpha, and where it is touched.
        colours: red, green and blue, or none.
        asked: front and level.
    """
    alpha, touched = seen
    front, level = (splat(builder, scalar) for scalar in asked)
    before = state.load(0)
    weight = alpha * before
    after = before - weight
    goes_on = after.compare(">", TRANSMITTANCE_MIN)
    blended = builder.and_(touched, goes_on)
    finished = builder.and_(touched, builder.not_(goes_on))
    weight = weight.where(blended, 0.0)
    new = (before - weight).negative_where(finished)
    state.store(0, new)
    for plane, value in enumerate(colours, start=1):
        state.store(plane, weight.fused(splat(builder, value), state.load(plane)))
    crossing = builder.or_(_crossed(before, after, 0.5), _crossed(before, after, level))
    crossing = builder.and_(blended, crossing)
    last = 1 + len(colours)
    held = state.load(last)
    state.store(last, held + (front - held).where(crossing, 0.0))
    mask = builder.bitcast(new.compare(">", 0.0), ir.IntType(LANES))
    return builder.zext(mask, ir.IntType(64))


def _crossed(before: Lanes, after: Lanes, level: Lanes | float) -> Any:
    """Where the transmittance goes from above a level to it or below."""
    return before.builder.and_(before.compare(">", level), after.compare("<=", level))


@intrinsic
def blend_label(  # type: ignore[no-untyped-def]
    typingctx, pixels, half, sharpness, offset, rest, red, green, blue, front, level
):
    """Colours and front of eight pixels; zero when all of them are finished."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        state = Planes(builder, array.data, arguments[1], planes=LABEL_PLANES)
        scalars = list(arguments[2:])
        return _blend(builder, state, _alpha(builder, scalars[:3]), scalars[3:6], scalars[6:])

    return types.int64(pixels, types.int64, *(types.float32,) * 8), generate


@intrinsic
def blend_own(  # type: ignore[no-untyped-def]
    typingctx, own, place, sharpness, offset, rest, front, level
):
    """Front of eight pixels among the records of one object; zero when all are finished."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        state = Planes(builder, array.data, arguments[1], planes=OWN_PLANES)
        scalars = list(arguments[2:])
        return _blend(builder, state, _alpha(builder, scalars[:3]), [], scalars[3:])

    return types.int64(own, types.int64, *(types.float32,) * 5), generate


@intrinsic
def blend_both(  # type: ignore[no-untyped-def]
    typingctx, pixels, half, own, place, sharpness, offset, rest, red, green, blue, front, level
):
    """Both of these at the price of one alpha; the bits of the own pixels are eight higher."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        state = Planes(builder, array.data, arguments[1], planes=LABEL_PLANES)
        array = context.make_array(signature.args[2])(context, builder, arguments[2])
        alone = Planes(builder, array.data, arguments[3], planes=OWN_PLANES)
        scalars = list(arguments[4:])
        seen, asked = _alpha(builder, scalars[:3]), scalars[6:]
        bits = _blend(builder, state, seen, scalars[3:6], asked)
        own_bits = _blend(builder, alone, seen, [], asked)
        return builder.or_(bits, builder.shl(own_bits, ir.Constant(own_bits.type, LANES)))

    kinds = (pixels, types.int64, own, types.int64, *(types.float32,) * 8)
    return types.int64(*kinds), generate
