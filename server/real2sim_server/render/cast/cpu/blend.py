"""Following the rays of each tile, from near to far.

Tiles are dealt to tasks by a fixed pattern and share nothing, so any number of threads gives the
same bits.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from ...backends.cpu.kernel import inlined, kernel
from ...backends.cpu.lanes import LANES
from ...backends.cpu.simd import lowest_bit, prefetch
from .blend_lanes import (
    FIRST,
    LIGHT,
    LOST,
    MEDIAN,
    MEMBERS,
    OWNER,
    RANGES,
    RAY,
    REFLECTED,
    STATE,
    cast_returns,
    cast_single,
    close_group,
    met_groups,
    place_rays,
)
from .layout import GROUPS, TILE_RAYS
from .records import BODY, HIGH, LOW

TASKS = 64
LOOK_AHEAD = 4
F32 = np.float32
ALL_GROUPS = (1 << GROUPS) - 1


@kernel(parallel=PARALLEL_LOOPS)
def follow_rays(values, lists, starts, layout, motions, origins, limits, modes, lights):
    """Follow every ray of every tile.

    Args:
        values: [M, RECORD] float32.
        lists: [L] int32, record indices by tile, near to far.
        starts: [tiles + 1] int64.
        motions: [bodies] int64, which of ``origins`` a body moves by; 0 stands still.
        origins: [motions, S, 12] float32, from the sensor's frame to that of the sweep as this
            motion has it, at each instant.
        limits: [3] float32: near, far and pulse [m].
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
    """Clear the state; bits of the groups that hold rays."""
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
    """Write the rays of a tile as a moving body meets them."""
    for group in range(GROUPS):
        for lane in range(LANES):
            frame = frames_of_motion[layout.slots[tile, group * LANES + lane]]
            for k in range(12):
                frames[k * LANES + lane] = frame[k]
        directions = layout.directions[tile]
        place_rays(directions, np.int64(group), frames, bank, np.int64(motion * GROUPS + group))


@inlined()
def write_rays(rays, state, out, owners, several):
    """Put what the rays of a tile met where their LiDAR has them."""
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
