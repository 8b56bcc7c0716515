"""The sky behind an image, forward and backward: Sky.sample in Numba.

The backward pass distributes texel rows over tasks. Each task scans all pixels in the same order
for its rows, so no two threads add to the same texel.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ..._numba import PARALLEL_LOOPS
from .lanes import inlined, kernel

F32 = np.float32
ZERO = F32(0)
ONE = F32(1)
HALF = F32(0.5)
CLEAR = F32(1e-5)
"""Transmittance below which the sky is skipped."""
TASKS = 16
"""Number of tasks. Rows are assigned round-robin, because rows of open sky cost more.

A power of two: the low bits of a row are its task.
"""


@kernel(parallel=PARALLEL_LOOPS)
def add_sky(faces, matrix, first, rgb, alpha):
    """Add ``(1 - alpha) * sky`` to rows of ``rgb``.

    Args:
        faces: [6, R, R, 3] float32 in C order, as in Sky.
        matrix: [3, 3] float32 ``R_world_camera K^-1``, maps (x, y, 1) [px] to directions.
        first: image row of the first row of ``rgb``.
        rgb: [H, W, 3] float32, added to.
        alpha: [H, W] float32.
    """
    height, width = alpha.shape
    texels = faces.reshape(-1)
    for task in prange(TASKS):
        # Two passes: the first computes texel positions without branches, so that it vectorises.
        corners = np.empty(width, np.int32)
        columns, rows = np.empty(width, np.float32), np.empty(width, np.float32)
        for row in range(task, height, TASKS):
            y = F32(first + row) + HALF
            for x in range(width):
                direction = pixel_direction(matrix, F32(x) + HALF, y)
                corners[x], rows[x], columns[x] = texel_corner(direction, faces.shape[1])
            for x in range(width):
                weight = ONE - alpha[row, x]
                if weight > CLEAR:
                    corner, down, right = np.uint64(corners[x]), rows[x], columns[x]
                    add_sample(texels, faces.shape[1], corner, down, right, weight, rgb[row, x])


@inlined()
def pixel_direction(matrix, x, y):
    """World direction of the ray through (x, y) [px]."""
    return (
        x * matrix[0, 0] + y * matrix[0, 1] + matrix[0, 2],
        x * matrix[1, 0] + y * matrix[1, 1] + matrix[1, 2],
        x * matrix[2, 0] + y * matrix[2, 1] + matrix[2, 2],
    )


@inlined()
def texel_corner(direction, size):
    """Offset of the upper left texel, and the weights of the lower and right texels."""
    face, row, column = texel_coordinates(direction, size)
    last = np.int32(max(size - 2, 0))
    r0, c0 = min(np.int32(row), last), min(np.int32(column), last)
    corner = ((face * np.int32(size) + r0) * np.int32(size) + c0) * np.int32(3)
    return corner, row - F32(r0), column - F32(c0)


@inlined()
def add_sample(texels, size, corner, down, right, weight, out):
    """Add the bilinear sample of four texels, times ``weight``, to ``out`` [3]."""
    next_column = np.uint64(3 if size > 1 else 0)
    next_row = np.uint64(3 * size if size > 1 else 0)
    for k in range(3):
        first = corner + np.uint64(k)
        top = texels[first] * (ONE - right) + texels[first + next_column] * right
        first += next_row
        bottom = texels[first] * (ONE - right) + texels[first + next_column] * right
        out[k] += weight * (top * (ONE - down) + bottom * down)


@inlined()
def texel_coordinates(direction, size):
    """Face index, and row and column in texels, clamped to the texel centres."""
    face, u, v = face_coordinates(direction)
    limit = F32(size - 1)
    column = min(max((u + ONE) / F32(2) * F32(size) - HALF, ZERO), limit)
    row = min(max((v + ONE) / F32(2) * F32(size) - HALF, ZERO), limit)
    return face, row, column


@inlined()
def bilinear(face, row, column, k):
    """Bilinear sample of channel ``k`` of a face [R, R, 3]."""
    c0, r0 = np.int64(math.floor(column)), np.int64(math.floor(row))
    c1, r1 = min(c0 + 1, face.shape[0] - 1), min(r0 + 1, face.shape[0] - 1)
    fc, fr = column - F32(c0), row - F32(r0)
    top = face[r0, c0, k] * (ONE - fc) + face[r0, c1, k] * fc
    bottom = face[r1, c0, k] * (ONE - fc) + face[r1, c1, k] * fc
    return top * (ONE - fr) + bottom * fr


@inlined()
def face_coordinates(direction):
    """Face index and u, v in [-1, 1]; see scene.sky.face_coordinates. Without branches."""
    x, y, z = direction
    ax, ay, az = abs(x), abs(y), abs(z)
    by_x = ax >= ay and ax >= az
    by_y = not by_x and ay >= az
    along = x if by_x else (y if by_y else z)
    largest = ax if by_x else (ay if by_y else az)
    axis = np.int32(0) if by_x else (np.int32(2) if by_y else np.int32(4))
    forward = along > ZERO
    sign = ONE if forward else -ONE
    u = -sign * y if by_x else (sign * x if by_y else -y)
    v = sign * x if not (by_x or by_y) else -z
    return axis + (np.int32(0) if forward else np.int32(1)), u / largest, v / largest


# Cameras with lenses


@kernel(parallel=PARALLEL_LOOPS)
def add_ray_sky(faces, turn, rays, rgb, alpha):
    """Add ``(1 - alpha) * sky`` to ``rgb``, except outside the lens.

    Args:
        faces: [6, R, R, 3] float32 in C order, as in Sky.
        turn: [3, 3] float32, rotation of rays to the world frame.
        rays: [H, W, 3] float32, 0 outside the lens.
        rgb: [H, W, 3] float32, added to.
        alpha: [H, W] float32.
    """
    height, width = alpha.shape
    texels = faces.reshape(-1)
    for task in prange(TASKS):
        # As in add_sky, the first pass has no branches.
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


# Backward pass

I32 = np.int32
OWNER = I32(TASKS - 1)


@kernel(parallel=PARALLEL_LOOPS)
def sample_sky(faces, matrix, behind, rows, places):
    """Sample the sky at all pixels, and write the colours and sample positions.

    Args:
        faces: [6, R, R, 3] float32, as in Sky.
        matrix: [3, 3] float32, as for add_sky.
        behind: [H, W, 3] float32, written: colours.
        rows: [H, W] int32, written: upper texel row, with the faces stacked vertically.
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
    """Add the gradients with respect to the faces from one camera's image.

    Args:
        rows, places: from sample_sky.
        alpha: [H, W] float32.
        by_rgb: [H, W, 3] float32, loss gradients with respect to the image.
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
    """Add to two neighbouring texels of a row."""
    size = gradient.shape[1]
    c0 = np.int64(math.floor(column))
    c1 = min(c0 + 1, size - 1)
    fraction = column - F32(c0)
    face, row = row // size, row % size
    for k in range(3):
        gradient[face, row, c0, k] += weight * (ONE - fraction) * by_rgb[k]
        gradient[face, row, c1, k] += weight * fraction * by_rgb[k]
