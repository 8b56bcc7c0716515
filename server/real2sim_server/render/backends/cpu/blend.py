"""Front-to-back blending of the tiles.

Tiles are dealt to tasks by a fixed pattern and share nothing, so any number of threads gives the
same bits.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .kernel import inlined, kernel
from .lanes import LANES
from .records import (
    BLUE,
    DEPTH,
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
from .simd import (
    PLANES,
    blend_all,
    blend_rgb,
    blend_rgb_depth,
    blend_rgb_depth_instance,
    lowest_bit,
    prefetch,
    touched_halves,
)

TASKS = 64
"""Tiles are dealt to this many tasks in turn, which spreads dense parts of an image."""
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
        starts: [tiles + 1] int64, where the list of each tile starts.
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

    Half rows of eight pixels are numbered down the left half of the tile, then down the right one;
    each has ``planes`` of them, the first is its transmittance.
    Returns a bit for each that has something to draw.
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
    """Blend lists[first:last], near to far, until it ends or every pixel is finished."""
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
    """Blend one record over eight pixels; zero when all of them are finished."""
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
    """Put the background behind the tile and write it to the images."""
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
