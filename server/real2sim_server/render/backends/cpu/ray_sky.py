"""The sky behind the picture of a camera with a lens."""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.

from __future__ import annotations

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .kernel import kernel
from .sky import CLEAR, ONE, TASKS, add_sample, texel_corner

F32 = np.float32


@kernel(parallel=PARALLEL_LOOPS)
def add_ray_sky(faces, turn, rays, rgb, alpha):
    """Add ``(1 - alpha) * sky`` to ``rgb``, except where nothing is seen.

    Args:
        faces: [6, R, R, 3] float32 in C order, as in Sky.
        turn: [3, 3] float32, maps rays to the world.
        rays: [H, W, 3] float32, 0 where nothing is seen.
        rgb: [H, W, 3] float32, added to.
        alpha: [H, W] float32.
    """
    height, width = alpha.shape
    texels = faces.reshape(-1)
    for task in prange(TASKS):
        # As in add_sky, where a row looks comes first: it has no branches.
        corners = np.empty(width, np.int32)
        columns, rows = np.empty(width, np.float32), np.empty(width, np.float32)
        line = np.empty((3, width), np.float32)
        for row in range(task, height, TASKS):
            least = ONE
            for x in range(width):
                least = min(least, alpha[row, x])
            if not ONE - least > CLEAR:
                continue
            for x in range(width):
                for k in range(3):
                    line[k, x] = rays[row, x, k]
            for x in range(width):
                a, b, c = line[0, x], line[1, x], line[2, x]
                direction = (
                    turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c,
                    turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c,
                    turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c,
                )
                corners[x], rows[x], columns[x] = texel_corner(direction, faces.shape[1])
            for x in range(width):
                weight = ONE - alpha[row, x]
                if weight > CLEAR and (line[0, x] != 0 or line[1, x] != 0 or line[2, x] != 0):
                    corner, down, right = np.uint64(corners[x]), rows[x], columns[x]
                    add_sample(texels, faces.shape[1], corner, down, right, weight, rgb[row, x])
