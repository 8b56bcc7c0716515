"""Blending of tiles by the rays of their pixels; otherwise like :mod:`.blend`."""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .blend import HALVES, LOOK_AHEAD, TASKS
from .kernel import inlined, kernel
from .lanes import LANES
from .ray_simd import (
    RAY,
    RAY_PLANES,
    TIME,
    blend_moving_ray,
    blend_moving_ray_all,
    blend_ray,
    blend_ray_all,
)
from .records import FALLOFF, LEVEL, MEAN_X, MEAN_Y, SHARPNESS, SLOPE, TILE
from .simd import lowest_bit, prefetch, touched_halves

F32 = np.float32
HALF = F32(0.5)


@kernel(parallel=PARALLEL_LOOPS)
def blend_ray_tiles(
    values, lists, starts, tiles_x, first_tile, last_tile, background, rays, lines, by_row, images
):
    """Blend tiles [first_tile, last_tile) into Images.

    Args:
        values: [M, RAY_RECORD] float32.
        lists, starts, tiles_x, background: as in :func:`.blend.blend_tiles`.
        rays: [H, W, 3] float32, 0 where nothing is seen.
        lines: [H or W] float32, time of each row or column; [0] where all are taken at once.
        by_row: whether they are rows.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    rgb, alpha, depth, instance = images.rgb, images.alpha, images.depth, images.instance
    median = images.median
    everything = instance.shape[0] > 0 or median.shape[0] > 0
    kind = (1 if everything else 0) + (2 if lines.shape[0] > 0 else 0)
    halves_of = values.reshape(2 * values.shape[0], values.shape[1] // 2)
    for task in prange(TASKS):
        pixels = np.empty(TILE * HALVES * RAY_PLANES * LANES, np.float32)
        for tile in range(first_tile + task, last_tile, TASKS):
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            going = open_ray_tile(pixels, x0, y0, rays, lines, by_row)
            first, last = starts[tile], starts[tile + 1]
            blend_ray_tile(
                values, halves_of, lists, first, last, F32(x0), F32(y0), pixels, going, kind
            )
            write_ray_tile(pixels, x0, y0, background, rgb, alpha, depth, instance, median)


@inlined()
def open_ray_tile(pixels, x0, y0, rays, lines, by_row):
    """Like :func:`.blend.open_tile`; pixels that see nothing are finished, too."""
    pixels[:] = 0
    alive = np.int64(0)
    for row in range(min(TILE, rays.shape[0] - y0)):
        for column in range(min(TILE, rays.shape[1] - x0)):
            half = column // LANES * TILE + row
            p = half * RAY_PLANES * LANES + column % LANES
            ray = rays[y0 + row, x0 + column]
            seen = ray[0] != 0 or ray[1] != 0 or ray[2] != 0
            pixels[p] = F32(1) if seen else F32(-1)
            for k in range(3):
                pixels[p + (RAY + k) * LANES] = ray[k]
            if lines.shape[0] > 0:
                pixels[p + TIME * LANES] = lines[y0 + row if by_row else x0 + column]
            if seen:
                alive |= np.int64(1) << half
    return alive


@inlined()
def blend_ray_tile(values, halves_of, lists, first, last, x0, y0, pixels, alive, kind):
    """Blend lists[first:last], near to far, until it ends or every pixel is finished."""
    for position in range(first, last):
        ahead = np.int64(lists[min(position + LOOK_AHEAD, last - 1)])
        prefetch(halves_of, 2 * ahead)
        prefetch(halves_of, 2 * ahead + 1)
        record = values[lists[position]]
        x, y = x0 + HALF - record[MEAN_X], y0 + HALF - record[MEAN_Y]
        touched = touched_halves(
            x, y, record[SHARPNESS], record[SLOPE], record[FALLOFF], record[LEVEL]
        )
        touched &= alive
        while touched != 0:
            half = lowest_bit(touched)
            touched &= touched - 1
            going = blend_half_of_rays(pixels, half, record, kind)
            alive &= ~(np.int64(going == 0) << half)
        if alive == 0:
            break


@inlined()
def blend_half_of_rays(pixels, half, record, kind):
    """Blend one record over eight pixels; zero when all of them are finished."""
    if kind == 0:
        return blend_ray(pixels, half, record)
    if kind == 1:
        return blend_ray_all(pixels, half, record)
    if kind == 2:
        return blend_moving_ray(pixels, half, record)
    return blend_moving_ray_all(pixels, half, record)


@inlined()
def write_ray_tile(pixels, x0, y0, background, rgb, alpha, depth, instance, median):
    """Write the tile to the images, with the background behind, black where nothing is seen."""
    height, width = alpha.shape
    for row in range(min(TILE, height - y0)):
        for column in range(min(TILE, width - x0)):
            p = (column // LANES * TILE + row) * RAY_PLANES * LANES + column % LANES
            y, x = y0 + row, x0 + column
            left = abs(pixels[p])
            total = F32(1) - left
            # Finished before anything was drawn: sees nothing, not even what is behind.
            left = F32(0) if pixels[p] == F32(-1) else left
            alpha[y, x] = total
            for channel in range(3):
                seen = pixels[p + (1 + channel) * LANES]
                rgb[y, x, channel] = seen + left * background[channel]
            if depth.shape[0]:
                depth[y, x] = pixels[p + 4 * LANES] / total if total > 0 else F32(0)
            if instance.shape[0]:
                instance[y, x] = np.uint16(pixels[p + 5 * LANES])
            if median.shape[0]:
                median[y, x] = pixels[p + 6 * LANES]
