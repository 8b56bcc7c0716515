"""The sky behind the picture, backwards: gradients by the texels of its faces.

Texel rows are dealt to tasks, and each task looks through all pixels for its rows in the same
order, so that no two threads add to one texel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .kernel import inlined, kernel
from .sky import HALF, ONE, ZERO, bilinear, pixel_direction, texel_coordinates

TASKS = 16
"""A power of two, so that the owner of a row is its lowest bits."""
F32, I32 = np.float32, np.int32
OWNER = I32(TASKS - 1)


@kernel(parallel=PARALLEL_LOOPS)
def sample_sky(faces, matrix, behind, rows, places):
    """Colour of the sky at all pixels, and where on the faces they look.

    Args:
        faces: [6, R, R, 3] float32, as in Sky.
        matrix: [3, 3] float32, as for add_sky.
        behind: [H, W, 3] float32, written: colours.
        rows: [H, W] int32, written: the upper texel row, all faces below each other.
        places: [H, W, 2] float32, written: fraction towards the lower row, and column in texels.
    """
    height, width = rows.shape
    for y in prange(height):
        for x in range(width):
            direction = pixel_direction(matrix, F32(x) + HALF, F32(y) + HALF)
            face, row, column = texel_coordinates(direction, faces.shape[1])
            for k in range(3):
                behind[y, x, k] = bilinear(faces[face], row, column, k)
            upper = math.floor(row)
            rows[y, x] = face * faces.shape[1] + np.int64(upper)
            places[y, x, 0] = row - F32(upper)
            places[y, x, 1] = column


@kernel(parallel=PARALLEL_LOOPS)
def sky_backward(rows, places, alpha, by_rgb, gradient):
    """Add the gradients of one camera's picture by the faces.

    Args:
        rows, places: from sample_sky.
        alpha: [H, W] float32.
        by_rgb: [H, W, 3] float32, loss gradients by the picture.
        gradient: [6, R, R, 3] float32, added to.
    """
    height, width = alpha.shape
    for task in prange(TASKS):
        mine, before = I32(task), I32((task + TASKS - 1) % TASKS)
        for y in range(height):
            for x in range(width):
                row = rows[y, x]
                owner = row & OWNER
                if owner == mine:
                    share = (ONE - places[y, x, 0]) * (ONE - alpha[y, x])
                    add_texels(gradient, row, places[y, x, 1], share, by_rgb[y, x])
                if owner == before and places[y, x, 0] > ZERO:
                    share = places[y, x, 0] * (ONE - alpha[y, x])
                    add_texels(gradient, row + 1, places[y, x, 1], share, by_rgb[y, x])


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
