"""The innermost step of cast(): one Gaussian met by eight rays, as explicit vector code.

State of eight rays is STATE vectors in a row. Rays are six vectors: origin and direction.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic

from ...backends.base import ALPHA_MAX
from ...backends.cpu.lanes import FLOAT, I64, Lanes, Planes, mask_bits, splat
from ...backends.cpu.records import EXPONENT_LIMIT
from ...backends.cpu.simd import exponential
from ...backends.cpu.vectors import dot, whitened
from ..types import ECHO_MIN, HALF_LIGHT, TRANSMITTANCE_MIN
from .records import (
    BODY,
    HIGH,
    LEVEL,
    LOSS,
    LOW,
    MEAN,
    MEMBER,
    RECORD,
    REFLECTIVITY,
    WHITENING,
)

LIGHT, RANGES, REFLECTED, LOST = 0, 1, 2, 3
"""Transmittance, and sums of w tau, w reflectivity and w loss."""
MEDIAN, OWNER, MEMBERS = 4, 5, 6
"""Range, body and member where the light falls to a half."""
ECHO = 7
"""Four: the echo that is still growing: its last range, sums of power, power tau and power
reflectivity."""
FIRST, STRONGEST, LAST = 11, 14, 17
"""Three each: range, power, reflectivity."""
STATE = 20
RAY = 6


def _build(
    rays: Planes, state: Planes, record: list[Lanes], limits: list[Lanes], *, returns: bool
) -> Any:
    """Emit the meeting of one record; returns bits of the rays that go on."""
    builder = state.builder
    near, far, pulse = limits
    origin = [rays.load(k) for k in range(3)]
    direction = [rays.load(3 + k) for k in range(3)]
    mean = record[MEAN : MEAN + 3]
    whitening = record[WHITENING : WHITENING + 6]
    start = whitened(whitening, [o - m for o, m in zip(origin, mean, strict=True)])
    along = whitened(whitening, direction)
    inverse = dot(along, along).reciprocal()
    # |start x along|^2 / |along|^2 keeps the digits that |start|^2 - (start along)^2 / |along|^2
    # loses.
    off = [start[i] * along[j] - start[j] * along[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    exponent = dot(off, off).fused(inverse, record[LEVEL])
    tau = -(dot(start, along) * inverse)
    alpha = exponential(exponent)
    alpha = alpha.where(alpha.compare("<", ALPHA_MAX), ALPHA_MAX)

    before = state.load(LIGHT)
    met = exponent.compare("<=", EXPONENT_LIMIT)
    for test in (
        tau.compare(">=", near),
        tau.compare("<=", far),
        before.compare(">", TRANSMITTANCE_MIN),
    ):
        met = builder.and_(met, test)
    weight = (alpha * before).where(met, 0.0)
    after = before - weight
    state.store(LIGHT, after)
    reflectivity = record[REFLECTIVITY]
    for plane, value in ((RANGES, tau), (REFLECTED, reflectivity), (LOST, record[LOSS])):
        state.store(plane, weight.fused(value, state.load(plane)))
    halving = builder.and_(before.compare(">", HALF_LIGHT), after.compare("<=", HALF_LIGHT))
    for plane, value in ((MEDIAN, tau), (OWNER, record[BODY]), (MEMBERS, record[MEMBER])):
        state.store(plane, value.where(halving, state.load(plane)))
    if returns:
        power = weight * before
        _grow_echo(state, met, tau, power, reflectivity, pulse)
    return mask_bits(builder, after.compare(">", TRANSMITTANCE_MIN))


def _grow_echo(
    state: Planes, met: Any, tau: Lanes, power: Lanes, reflectivity: Lanes, pulse: Lanes
) -> None:
    """Add to the echo of each ray, or close it and begin another where this lies apart."""
    builder = state.builder
    total = state.load(ECHO + 1)
    apart = (tau - state.load(ECHO)).magnitude().compare(">", pulse)
    ends = builder.and_(met, builder.and_(apart, total.compare(">", 0.0)))
    close_echo(state, ends)
    kept = [state.load(ECHO + k) for k in range(4)]
    zero = tau * 0.0
    kept = [kept[0], *(zero.where(ends, value) for value in kept[1:])]
    state.store(ECHO, tau.where(met, kept[0]))
    for plane, value in ((1, power), (2, power * tau), (3, power * reflectivity)):
        state.store(ECHO + plane, value.where(met, 0.0) + kept[plane])


def close_echo(state: Planes, ends: Any) -> None:
    """Take the echoes of those rays as returns, where they are strong enough."""
    builder = state.builder
    power = state.load(ECHO + 1)
    is_return = builder.and_(ends, power.compare(">=", ECHO_MIN))
    inverse = power.at_least(1e-9).reciprocal()
    values = [state.load(ECHO + 2) * inverse, power, state.load(ECHO + 3) * inverse]
    is_first = builder.and_(is_return, state.load(FIRST + 1).compare("<=", 0.0))
    is_strongest = builder.and_(is_return, power.compare(">", state.load(STRONGEST + 1)))
    for plane, mask in ((FIRST, is_first), (STRONGEST, is_strongest), (LAST, is_return)):
        for k, value in enumerate(values):
            state.store(plane + k, value.where(mask, state.load(plane + k)))


def _cast_intrinsic(*, returns: bool) -> Any:
    """In kernels: cast(rays, state, group, values, index, near, far, pulse); bits of the rays of
    the group that go on."""

    def cast(typingctx, rays, state, bank, group, values, index, near, far, pulse):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            def data(number: int) -> Any:
                kind = signature.args[number]
                return context.make_array(kind)(context, builder, arguments[number]).data

            met = Planes(builder, data(0), arguments[2], planes=RAY)
            held = Planes(builder, data(1), arguments[3], planes=STATE)
            first = builder.mul(arguments[5], I64(RECORD))
            record: list[Any] = []
            for field in range(RECORD):
                if field in (LOW, HIGH):
                    record.append(None)
                    continue
                place = builder.add(first, I64(field))
                pointer = builder.gep(data(4), [place], source_etype=FLOAT)
                record.append(splat(builder, builder.load(pointer, typ=FLOAT)))
            limits = [splat(builder, value) for value in arguments[6:]]
            return _build(met, held, record, limits, returns=returns)

        floats = (types.float32,) * 3
        return types.int64(rays, state, types.int64, types.int64, values, types.int64, *floats), (
            generate
        )

    return intrinsic(cast)


cast_single = _cast_intrinsic(returns=False)
cast_returns = _cast_intrinsic(returns=True)


@intrinsic
def close_group(typingctx, state, group):  # type: ignore[no-untyped-def]
    """Take the last echo of each ray of a group."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        held = Planes(builder, array.data, arguments[1], planes=STATE)
        close_echo(held, held.load(ECHO + 1).compare(">", 0.0))
        return context.get_dummy_value()

    return types.void(state, types.int64), generate


@intrinsic
def met_groups(typingctx, lows, highs, low, high):  # type: ignore[no-untyped-def]
    """Bits of the eight groups of a tile that reach into elevations from ``low`` to ``high``."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        bounds = []
        for number in range(2):
            array = context.make_array(signature.args[number])(context, builder, arguments[number])
            bounds.append(Planes(builder, array.data, I64(0), planes=1).load(0))
        low, high = (splat(builder, value) for value in arguments[2:])
        above = bounds[1].compare(">=", low)
        return mask_bits(builder, builder.and_(above, bounds[0].compare("<=", high)))

    return types.int64(lows, highs, types.float32, types.float32), generate


@intrinsic
def place_rays(typingctx, directions, group, frame, rays, bank):  # type: ignore[no-untyped-def]
    """Turn eight directions [8, 3, 8] of a tile by frames [8, 12], a row for each ray, and write
    their origins and directions to ``rays``."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        def data(number: int) -> Any:
            kind = signature.args[number]
            return context.make_array(kind)(context, builder, arguments[number]).data

        given = Planes(builder, data(0), arguments[1], planes=3)
        frames = Planes(builder, data(2), I64(0), planes=12)
        out = Planes(builder, data(3), arguments[4], planes=RAY)
        d = [given.load(k) for k in range(3)]
        for row in range(3):
            turn = [frames.load(4 * row + k) for k in range(3)]
            out.store(row, frames.load(4 * row + 3))
            out.store(3 + row, dot(turn, d))
        return context.get_dummy_value()

    return types.void(directions, types.int64, frame, rays, types.int64), generate


__all__ = [
    "cast_returns",
    "cast_single",
    "close_group",
    "met_groups",
    "place_rays",
]
