"""Tracing rays through the Gaussians of their tile, from near to far.

Tiles are assigned to tasks in a fixed pattern and share nothing, so results are bitwise independent
of the number of threads. The inner loop is explicit vector code for one Gaussian and eight rays.
The state of eight rays is STATE vectors; the rays are six vectors, origin and direction.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange, types
from numba.extending import intrinsic

from ..._numba import PARALLEL_LOOPS
from .._cpu.blend import exponential
from .._cpu.lanes import (
    FLOAT,
    I64,
    LANES,
    Lanes,
    Planes,
    dot,
    inlined,
    kernel,
    lowest_bit,
    mask_bits,
    prefetch,
    splat,
    whitened,
)
from .._cpu.records import EXPONENT_LIMIT
from ..backend import ALPHA_MAX
from .layout import (
    BODY,
    GROUPS,
    HIGH,
    LEVEL,
    LOSS,
    LOW,
    MEAN,
    MEMBER,
    RECORD,
    REFLECTIVITY,
    TILE_RAYS,
    WHITENING,
)
from .types import ECHO_MIN, HALF_LIGHT, TRANSMITTANCE_MIN

LIGHT, RANGES, REFLECTED, LOST = 0, 1, 2, 3
"""Transmittance, and sums of w tau, w reflectivity and w loss."""
MEDIAN, OWNER, MEMBERS = 4, 5, 6
"""Range, body and member at which transmittance falls to 0.5."""
ECHO = 7
"""Four planes of the open echo: its last range, and sums of power, power tau and power
reflectivity."""
FIRST, STRONGEST, LAST = 11, 14, 17
"""Three planes each: range, power, reflectivity."""
STATE = 20
RAY = 6


def _build(
    rays: Planes, state: Planes, record: list[Lanes], limits: list[Lanes], *, returns: bool
) -> Any:
    """Emit the absorption by one record; returns bits of the unfinished rays."""
    builder = state.builder
    near, far, pulse = limits
    origin = [rays.load(k) for k in range(3)]
    direction = [rays.load(3 + k) for k in range(3)]
    mean = record[MEAN : MEAN + 3]
    whitening = record[WHITENING : WHITENING + 6]
    start = whitened(whitening, [o - m for o, m in zip(origin, mean, strict=True)])
    along = whitened(whitening, direction)
    inverse = dot(along, along).reciprocal()
    # |start x along|^2 / |along|^2 stays precise where |start|^2 - (start along)^2 / |along|^2
    # cancels.
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
    """Add a sample to the open echo of each ray; if it is too far away, start a new echo."""
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
    """Close the echoes of the rays in ``ends``; record strong enough echoes as returns."""
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
    """The intrinsic cast(rays, state, bank, group, values, index, near, far, pulse).

    It returns the bits of the unfinished rays of the group.
    """

    def cast(typingctx, rays, state, bank, group, values, index, near, far, pulse):
        def generate(context, builder, signature, arguments):
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
def close_group(typingctx, state, group):
    """Close the last echo of each ray of a group."""

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        held = Planes(builder, array.data, arguments[1], planes=STATE)
        close_echo(held, held.load(ECHO + 1).compare(">", 0.0))
        return context.get_dummy_value()

    return types.void(state, types.int64), generate


@intrinsic
def met_groups(typingctx, lows, highs, low, high):
    """Bits of the eight groups of a tile that overlap elevations from ``low`` to ``high``."""

    def generate(context, builder, signature, arguments):
        bounds = []
        for number in range(2):
            array = context.make_array(signature.args[number])(context, builder, arguments[number])
            bounds.append(Planes(builder, array.data, I64(0), planes=1).load(0))
        low, high = (splat(builder, value) for value in arguments[2:])
        above = bounds[1].compare(">=", low)
        return mask_bits(builder, builder.and_(above, bounds[0].compare("<=", high)))

    return types.int64(lows, highs, types.float32, types.float32), generate


@intrinsic
def place_rays(typingctx, directions, group, frame, rays, bank):
    """Write origins and directions of a group's rays to ``rays``.

    Directions [8, 3, 8] of a tile are rotated by the frames [8, 12], one row per ray.
    """

    def generate(context, builder, signature, arguments):
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


# Tracing the rays of a tile


TASKS = 64
LOOK_AHEAD = 4
F32 = np.float32


@kernel(parallel=PARALLEL_LOOPS)
def follow_rays(values, lists, starts, layout, motions, origins, limits, modes, lights):
    """Trace all rays of all tiles.

    Args:
        values: [M, RECORD] float32.
        lists: [L] int32, record indices by tile, near to far.
        starts: [tiles + 1] int64.
        motions: [bodies] int64, index into ``origins`` of each body's motion; 0 is stationary.
        origins: [motions, S, 12] float32, sensor frame to sweep frame for this motion, at each
            instant.
        limits: [3] float32: near, far and pulse length [m].
        modes: number of returns.
        lights: Lights, written.
    """
    out, owners, several = lights.values, lights.owners, lights.returns
    tiles, groups_of_bank = layout.rays.shape[0], GROUPS
    near, far, pulse = limits[0], limits[1], limits[2]
    for task in prange(TASKS):
        bank = np.empty(origins.shape[0] * GROUPS * RAY * LANES, np.float32)
        filled = np.full(origins.shape[0], -1, np.int64)
        state = np.empty(GROUPS * STATE * LANES, np.float32)
        frames = np.empty(12 * LANES, np.float32)
        for tile in range(task, tiles, TASKS):
            alive = open_rays(layout, tile, state)
            lows, highs = layout.lows[tile], layout.highs[tile]
            first, last = starts[tile], starts[tile + 1]
            for position in range(first, last):
                prefetch(values, np.int64(lists[min(position + LOOK_AHEAD, last - 1)]))
                index = np.int64(lists[position])
                record = values[index]
                touched = met_groups(lows, highs, record[LOW], record[HIGH]) & alive
                if touched == 0:
                    continue
                motion = motions[np.int64(record[BODY])]
                if filled[motion] != tile:
                    fill_bank(layout, tile, origins[motion], motion, frames, bank)
                    filled[motion] = tile
                while touched != 0:
                    group = lowest_bit(touched)
                    touched &= touched - 1
                    place = motion * groups_of_bank + group
                    if modes > 1:
                        going = cast_returns(
                            bank, state, place, group, values, index, near, far, pulse
                        )
                    else:
                        going = cast_single(
                            bank, state, place, group, values, index, near, far, pulse
                        )
                    alive &= ~(np.int64(going == 0) << group)
                if alive == 0:
                    break
            if modes > 1:
                for group in range(GROUPS):
                    close_group(state, np.int64(group))
            write_rays(layout.rays[tile], state, out, owners, several)


@inlined()
def open_rays(layout, tile, state):
    """Clear the state; returns bits of the groups that have rays."""
    state[:] = 0
    alive = np.int64(0)
    for ray in range(TILE_RAYS):
        group, lane = ray // LANES, ray % LANES
        state[(group * STATE + OWNER) * LANES + lane] = -1
        state[(group * STATE + MEMBERS) * LANES + lane] = -1
        if layout.rays[tile, ray] >= 0:
            state[(group * STATE + LIGHT) * LANES + lane] = 1
            alive |= np.int64(1) << group
    return alive


@inlined()
def fill_bank(layout, tile, frames_of_motion, motion, frames, bank):
    """Write the rays of a tile relative to a moving body."""
    for group in range(GROUPS):
        for lane in range(LANES):
            frame = frames_of_motion[layout.slots[tile, group * LANES + lane]]
            for k in range(12):
                frames[k * LANES + lane] = frame[k]
        directions = layout.directions[tile]
        place_rays(directions, np.int64(group), frames, bank, np.int64(motion * GROUPS + group))


@inlined()
def write_rays(rays, state, out, owners, several):
    """Write the results of a tile's rays in the order of the LiDAR's rays."""
    for ray in range(TILE_RAYS):
        index = rays[ray]
        if index >= 0:
            place = ray // LANES * STATE * LANES + ray % LANES
            stopped = F32(1) - state[place + LIGHT * LANES]
            share = F32(1) / stopped if stopped > 0 else F32(0)
            out[index, 0] = state[place + MEDIAN * LANES]
            out[index, 1] = state[place + RANGES * LANES] * share
            out[index, 2] = stopped
            out[index, 3] = state[place + REFLECTED * LANES] * share
            out[index, 4] = state[place + LOST * LANES] * share
            owners[index, 0] = np.int32(state[place + OWNER * LANES])
            owners[index, 1] = np.int32(state[place + MEMBERS * LANES])
            if several.shape[0]:
                for k in range(9):
                    several[index, k] = state[place + (FIRST + k) * LANES]


# Lists of the Gaussians that each ray hits, for fitting to recorded sweeps


@kernel(parallel=PARALLEL_LOOPS)
def list_hits(
    values, lists, starts, layout, motions, origins, limits, firsts, reach, begins, members, shares
):
    """Count the Gaussians that rays hit, or list them from near to far.

    Args:
        values, lists, starts, layout, motions, origins, limits: as for ``follow_rays``.
        firsts: [bodies] int64, index of the first Gaussian of each body.
        reach: [R] float32, length of each ray [m]; 0 follows the ray until its light is absorbed.
        begins: [R] int64; if ``members`` is empty, receives the counts; else the start of each
            ray's hits.
        members: [M] int32, written: indices of Gaussians.
        shares: [M, 2] float32, written: absorbed fraction of the arriving light, and range [m].
    """
    near, far, pulse = limits[0], limits[1], limits[2]
    for task in prange(TASKS):
        bank = np.empty(origins.shape[0] * GROUPS * RAY * LANES, np.float32)
        filled = np.full(origins.shape[0], -1, np.int64)
        state = np.empty(GROUPS * STATE * LANES, np.float32)
        frames = np.empty(12 * LANES, np.float32)
        light = np.empty(TILE_RAYS, np.float32)
        found = np.empty(TILE_RAYS, np.int64)
        for tile in range(task, layout.rays.shape[0], TASKS):
            alive = open_rays(layout, tile, state)
            light[:] = 1
            found[:] = 0
            lows, highs = layout.lows[tile], layout.highs[tile]
            for position in range(starts[tile], starts[tile + 1]):
                index = np.int64(lists[position])
                record = values[index]
                touched = met_groups(lows, highs, record[LOW], record[HIGH]) & alive
                if touched == 0:
                    continue
                body = np.int64(record[BODY])
                member, motion = firsts[body] + np.int64(record[MEMBER]), motions[body]
                if filled[motion] != tile:
                    fill_bank(layout, tile, origins[motion], motion, frames, bank)
                    filled[motion] = tile
                while touched != 0:
                    group = lowest_bit(touched)
                    touched &= touched - 1
                    open_group(state, group, light)
                    place = motion * GROUPS + group
                    cast_single(bank, state, place, group, values, index, near, far, pulse)
                    going = note_group(
                        layout.rays[tile], group, state, light, found, member, reach, begins,
                        members, shares,
                    )  # fmt: skip
                    alive &= ~(np.int64(not going) << group)
                if alive == 0:
                    break
            if members.shape[0] == 0:
                for spot in range(TILE_RAYS):
                    if layout.rays[tile, spot] >= 0:
                        begins[layout.rays[tile, spot]] = found[spot]


@inlined()
def note_group(rays, group, state, light, found, member, reach, begins, members, shares):
    """Count or list the latest hits of a group's rays; returns whether any ray continues."""
    going = False
    for lane in range(LANES):
        spot, at = group * LANES + lane, group * STATE * LANES + lane
        ray = rays[spot]
        if ray < 0 or light[spot] <= 0:
            continue
        share = F32(1) - state[at + LIGHT * LANES]
        if share > 0:
            tau = state[at + RANGES * LANES] / share
            if reach[ray] > 0 and tau > reach[ray]:
                light[spot] = 0
                continue
            if members.shape[0] > 0:
                entry = begins[ray] + found[spot]
                members[entry] = member
                shares[entry, 0], shares[entry, 1] = share, tau
            found[spot] += 1
            if reach[ray] <= 0:
                light[spot] *= F32(1) - share
                if light[spot] <= TRANSMITTANCE_MIN:
                    light[spot] = 0
        going |= light[spot] > 0
    return going


@inlined()
def open_group(state, group, light):
    """Reset the rays of a group: full light for those that continue, none for the others."""
    for lane in range(LANES):
        at = group * STATE * LANES + lane
        state[at + LIGHT * LANES] = F32(1) if light[group * LANES + lane] > 0 else F32(0)
        state[at + RANGES * LANES] = F32(0)
