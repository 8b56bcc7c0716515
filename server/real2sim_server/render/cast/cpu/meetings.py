"""Which Gaussians each ray meets and how, as lists, for what is fitted to recorded sweeps."""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from ...backends.cpu.kernel import inlined, kernel
from ...backends.cpu.lanes import LANES
from ...backends.cpu.simd import lowest_bit
from ..types import TRANSMITTANCE_MIN
from .blend import TASKS, fill_bank, open_rays
from .blend_lanes import LIGHT, RANGES, RAY, STATE, cast_single, met_groups
from .layout import GROUPS, TILE_RAYS
from .records import BODY, HIGH, LOW, MEMBER

F32 = np.float32


@kernel(parallel=PARALLEL_LOOPS)
def list_meetings(
    values, lists, starts, layout, motions, origins, limits, firsts, reach, begins, members, shares
):
    """Count the Gaussians that rays meet, or list them from near to far.

    A ray is followed up to its reach [m], or where that is 0 until its light has gone.

    Args:
        values, lists, starts, layout, motions, origins, limits: as of ``follow_rays``.
        firsts: [bodies] int64, number of the first Gaussian of each.
        reach: [R] float32.
        begins: [R] int64; where ``members`` is empty counts are written here, else it holds where
            each ray's meetings begin.
        members: [M] int32, written: numbers of Gaussians.
        shares: [M, 2] float32, written: the part of arriving light that is stopped, and where [m].
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
    """Count or list what the rays of a group have just met; whether any of them goes on."""
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
    """Full light and no sums for the rays of a group that go on, none for the others."""
    for lane in range(LANES):
        at = group * STATE * LANES + lane
        state[at + LIGHT * LANES] = F32(1) if light[group * LANES + lane] > 0 else F32(0)
        state[at + RANGES * LANES] = F32(0)
