"""The sky behind the picture, backwards: gradients by the texels of its faces.

Texel rows are dealt to tasks, and each task looks through all pixels for its rows in the same
order, so that no two threads add to one texel.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange

from .cpu_sky import HALF, ONE, bilinear, pixel_direction, texel_coordinates
from .kernel import inlined, kernel

TASKS = 16
F32 = np.float32


@kernel(parallel=True)
def sample_sky(faces, matrix, behind, places):
    """Colour of the sky at all pixels, and where on the faces they look.

    Args:
        faces: [6, R, R, 3] float32, as in Sky.
        matrix: [3, 3] float32, as for add_sky.
        behind: [H, W, 3] float32, written: colours.
        places: [H, W, 2] float32, written: face * R + row, and column, in texels.
    """
    height, width = behind.shape[:2]
    for y in prange(height):
        for x in range(width):
            direction = pixel_direction(matrix, F32(x) + HALF, F32(y) + HALF)
            face, row, column = texel_coordinates(direction, faces.shape[1])
            for k in range(3):
                behind[y, x, k] = bilinear(faces[face], row, column, k)
            places[y, x, 0] = F32(face * faces.shape[1]) + row
            places[y, x, 1] = column


@kernel(parallel=True)
def sky_backward(places, alpha, by_rgb, gradient):
    """Add the gradients of one camera's picture by the faces.

    Args:
        places: [H, W, 2] from sample_sky.
        alpha: [H, W] float32.
        by_rgb: [H, W, 3] float32, loss gradients by the picture.
        gradient: [6, R, R, 3] float32, added to.
    """
    height, width = alpha.shape
    size = gradient.shape[1]
    for task in prange(TASKS):
        for y in range(height):
            for x in range(width):
                row = np.int64(math.floor(places[y, x, 0]))
                if row % TASKS == task or (row + 1) % TASKS == task:
                    weight = ONE - alpha[y, x]
                    add_rows(places[y, x], row, size, task, weight, by_rgb[y, x], gradient)


@inlined()
def add_rows(place, row, size, task, weight, by_rgb, gradient):
    """Add one pixel to those of its two texel rows that the task owns."""
    below = row + 1 if row % size < size - 1 else row
    fraction = place[0] - F32(row)
    if row % TASKS == task:
        add_texels(gradient, row, place[1], weight * (ONE - fraction), by_rgb)
    if below % TASKS == task:
        add_texels(gradient, below, place[1], weight * fraction, by_rgb)


@inlined()
def add_texels(gradient, row, column, weight, by_rgb):
    """Add to two neighbouring texels of one row."""
    size = gradient.shape[1]
    c0 = np.int64(math.floor(column))
    c1 = min(c0 + 1, size - 1)
    fraction = column - F32(c0)
    face, row = row // size, row % size
    for k in range(3):
        gradient[face, row, c0, k] += weight * (ONE - fraction) * by_rgb[k]
        gradient[face, row, c1, k] += weight * fraction * by_rgb[k]
