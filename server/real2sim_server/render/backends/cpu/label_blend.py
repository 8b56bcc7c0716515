"""Colours and labels of tiles in one walk over their records.

Beside the colours each pixel learns which record is its front, and within the windows of objects
also which one would be if the object stood alone: where others have finished a pixel, the walk goes
on with the records of objects. Depth, object and class follow from the front, once for each pixel.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .blend import HALVES, LOOK_AHEAD, TASKS, open_tile
from .kernel import inlined, kernel
from .label_simd import LABEL_PLANES, OWN_PLANES, blend_both, blend_label, blend_own
from .lanes import LANES
from .records import (
    BLUE,
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
)
from .simd import lowest_bit, prefetch, touched_halves

F32 = np.float32
HALF = F32(0.5)
OWN = TILE * HALVES * OWN_PLANES * LANES
"""Numbers of one object in a tile."""
LEFT, TOP, RIGHT, BOTTOM, FIRST = 0, 1, 2, 3, 4
"""Of a window [px], and where its pixels start."""
ELSEWHERE, UNSEEN = -1, -2
"""In place of the half rows that an object goes on in: none of its window is in the tile, or none
of its records was met there."""
NO_RECORD = np.int64(1) << 62


@kernel(parallel=PARALLEL_LOOPS)
def blend_labels(
    values,
    lists,
    starts,
    tiles_x,
    first_tile,
    last_tile,
    background,
    level,
    objects,
    fronts,
    images,
):
    """Blend tiles [first_tile, last_tile) into RGB and alpha of Images, and find fronts.

    Args:
        values, lists, starts, background: as of blend_tiles.
        level: transmittance at which a pixel's front lies.
        objects: Objects.
        fronts: Fronts.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    rgb, alpha, pixel_fronts = images.rgb, images.alpha, fronts.pixels
    alone, used, windows = fronts.alone, fronts.used, objects.windows
    slots, first_record = objects.slots, objects.first_record
    for task in prange(TASKS):
        pixels = np.empty(TILE * HALVES * LABEL_PLANES * LANES, np.float32)
        own = np.empty(windows.shape[0] * OWN, np.float32)
        own_alive = np.empty(windows.shape[0], np.int64)
        for tile in range(first_tile + task, last_tile, TASKS):
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            alive = open_tile(pixels, LABEL_PLANES, x0, y0, alpha.shape)
            watched = watch(own_alive, windows, x0, y0)
            label_tile(
                values, lists, starts[tile], starts[tile + 1], F32(x0), F32(y0), pixels, alive,
                own, own_alive, slots, first_record if watched else NO_RECORD, level,
            )  # fmt: skip
            write_colours(pixels, x0, y0, background, rgb, alpha, pixel_fronts, used)
            if watched:
                write_own(own, own_alive, windows, x0, y0, alpha.shape, alone, used)


@inlined()
def meets(window, x0, y0):
    """Whether a window has pixels of a tile."""
    across = window[LEFT] < x0 + TILE and window[RIGHT] > x0
    return across and window[TOP] < y0 + TILE and window[BOTTOM] > y0


@inlined()
def watch(own_alive, windows, x0, y0):
    """Note the objects whose windows meet the tile; whether there are any."""
    watched = False
    for slot in range(windows.shape[0]):
        own_alive[slot] = ELSEWHERE
        if meets(windows[slot], x0, y0):
            own_alive[slot] = UNSEEN
            watched = True
    return watched


@inlined()
def open_own(own, slot):
    """Clear the state of an object."""
    for half in range(TILE * HALVES):
        place = slot * OWN + half * OWN_PLANES * LANES
        own[place : place + LANES] = 1
        own[place + LANES : place + 2 * LANES] = 0


@inlined()
def label_tile(
    values, lists, first, last, x0, y0, pixels, alive, own, own_alive, slots, first_record, level
):
    """Blend lists[first:last], near to far; records from ``first_record`` on may be of objects that
    are watched."""
    inside = alive
    for position in range(first, last):
        index = np.int64(lists[position])
        if alive == 0 and index < first_record:
            if first_record == NO_RECORD:
                break
            continue
        prefetch(values, np.int64(lists[min(position + LOOK_AHEAD, last - 1)]))
        record = values[index]
        slot, wanted = np.int64(-1), np.int64(0)
        if index >= first_record:
            slot = np.int64(slots[np.int64(record[INSTANCE])])
            if slot >= 0:
                wanted = own_alive[slot]
                if wanted == UNSEEN:
                    open_own(own, slot)
                    own_alive[slot] = wanted = inside
                elif wanted == ELSEWHERE:
                    slot, wanted = np.int64(-1), np.int64(0)
        if alive | wanted == 0:
            continue
        alive, wanted = blend_record(
            record, F32(index + 1), x0, y0, pixels, alive, own, slot, wanted, level
        )
        if slot >= 0:
            own_alive[slot] = wanted


@inlined()
def blend_record(record, front, x0, y0, pixels, alive, own, slot, wanted, level):
    """Blend one record; returns the half rows that go on, of the picture and of its object."""
    x, y = x0 + HALF - record[MEAN_X], y0 + HALF - record[MEAN_Y]
    sharpness, slope = record[SHARPNESS], record[SLOPE]
    falloff, lowest = record[FALLOFF], record[LEVEL]
    red, green, blue = record[RED], record[GREEN], record[BLUE]
    touched = touched_halves(x, y, sharpness, slope, falloff, lowest) & (alive | wanted)
    while touched != 0:
        half = lowest_bit(touched)
        touched &= touched - 1
        dy = y + F32(half % TILE)
        start = x - slope * dy + F32(half // TILE * LANES)
        rest = falloff * dy * dy + lowest
        place = slot * TILE * HALVES + half
        if (wanted >> half) & 1 == 0:
            going = blend_label(
                pixels, half, sharpness, start, rest, red, green, blue, front, level
            )
            alive &= ~(np.int64(going == 0) << half)
        elif (alive >> half) & 1 == 0:
            going = blend_own(own, place, sharpness, start, rest, front, level)
            wanted &= ~(np.int64(going == 0) << half)
        else:
            going = blend_both(
                pixels, half, own, place, sharpness, start, rest, red, green, blue, front, level
            )
            alive &= ~(np.int64(going & 255 == 0) << half)
            wanted &= ~(np.int64(going >> 8 == 0) << half)
    return alive, wanted


@inlined()
def write_colours(pixels, x0, y0, background, rgb, alpha, fronts, used):
    """Put the background behind the tile and write it to the images."""
    height, width = alpha.shape
    for row in range(min(TILE, height - y0)):
        for column in range(min(TILE, width - x0)):
            p = (column // LANES * TILE + row) * LABEL_PLANES * LANES + column % LANES
            y, x = y0 + row, x0 + column
            left = abs(pixels[p])
            alpha[y, x] = F32(1) - left
            for channel in range(3):
                rgb[y, x, channel] = pixels[p + (1 + channel) * LANES] + left * background[channel]
            front = np.int32(pixels[p + 4 * LANES])
            fronts[y, x] = front
            used[front] = 1


@inlined()
def write_own(own, own_alive, windows, x0, y0, shape, alone, used):
    """Write the fronts of objects that are watched in the tile."""
    for slot in range(windows.shape[0]):
        if own_alive[slot] < 0:
            continue
        window = windows[slot]
        across = window[RIGHT] - window[LEFT]
        for y in range(max(y0, window[TOP]), min(y0 + TILE, window[BOTTOM])):
            for x in range(max(x0, window[LEFT]), min(x0 + TILE, window[RIGHT])):
                half = (x - x0) // LANES * TILE + y - y0
                place = slot * OWN + half * OWN_PLANES * LANES + LANES + (x - x0) % LANES
                front = np.int32(own[place])
                alone[window[FIRST] + (y - window[TOP]) * across + x - window[LEFT]] = front
                used[front] = 1
