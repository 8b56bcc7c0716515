"""Blending backwards: from loss gradients by pixels to gradients by records.

Each place in a tile's list writes to a slot of its own, so any number of threads gives the same
bits.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ...._numba import PARALLEL_LOOPS
from .blend import HALF, LOOK_AHEAD, TASKS
from .kernel import inlined, kernel
from .lanes import LANES
from .records import BLUE, DEPTH, FALLOFF, GREEN, LEVEL, MEAN_X, MEAN_Y, RED, SHARPNESS, SLOPE, TILE
from .simd import prefetch, touched_halves
from .simd_backward import (
    ABS_X,
    ABS_Y,
    BACKWARD_PLANES,
    BY_ALPHA,
    BY_DEPTH,
    BY_RED,
    LEFT,
    MIDDLE,
    REST,
    SUM_1,
    SUM_BLUE,
    SUM_DEPTH,
    SUM_GREEN,
    SUM_RED,
    SUM_X,
    SUM_XX,
    SUM_XY,
    SUM_Y,
    SUM_YY,
    SUMS,
    blend_backward,
)

F32 = np.float32
ZERO, ONE, TWO, CENTRE = F32(0), F32(1), F32(2), F32(MIDDLE)
HALVES = 2 * TILE
SLOT = 12
"""float32 values of a slot: the sums of SUM_1 to SUM_DEPTH, x and y there from the record's centre
along its axes: dx' = dx - slope dy, and dy."""


class Losses(NamedTuple):
    """Loss gradients by the images of one camera; [0, 0] (rgb: [0, 0, 0]) where there is none."""

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]


@kernel(parallel=PARALLEL_LOOPS)
def open_pixels(images, losses, behind, tiles_x, pixels):
    """Write the state from which the walk backwards starts.

    With A the accumulated opacity and g the loss gradients, the loss changes by g_rgb · d(sum w c)
    + g_depth / A · d(sum w z) + (g_alpha - g_rgb · behind - g_depth depth / A) · d(sum w).

    Args:
        images: Images of the forward pass, after the sky.
        losses: Losses.
        behind: [H, W, 3] float32, or [1, 1, 3] where it is one colour: seen behind everything.
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
    """The state of one pixel."""
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
    """Walk all tiles and write the gradients of each record in each tile to its slot.

    Args:
        values: [M, RECORD] float32.
        lists, slots: [L] int32, record and slot at each place, by tile, near to far.
        starts: [tiles + 1] int64, where the list of each tile starts.
        tiles_x: tiles in a row of the image.
        shape: height and width of the image [px].
        pixels: from open_pixels; used up.
        gradients: [L, SLOT] float32, written where the record touched a pixel.
        used: [L] uint8, written: whether it did.
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
    """Bits of the half rows that have a pixel inside the image."""
    bits = (np.int64(1) << min(rows, TILE)) - 1
    return bits | bits << TILE if columns > LANES else bits


@inlined()
def walk(pixels, tile, touched, x, y, record, sums):
    """One record over one tile; see blend_backward."""
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
    """Shift the moments from the tile's centre to the record's centre and axes."""
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
