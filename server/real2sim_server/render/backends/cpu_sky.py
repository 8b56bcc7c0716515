"""The sky behind the picture: the twin of Sky.sample in Numba."""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange

from .kernel import inlined, kernel

F32 = np.float32
ZERO, ONE, HALF = F32(0), F32(1), F32(0.5)
OPAQUE = F32(1 - 1e-5)
"""Nothing of the sky is seen through alpha at or above this."""


@kernel(parallel=True)
def add_sky(faces, matrix, rgb, alpha):
    """Add ``(1 - alpha) * sky`` to ``rgb``.

    Args:
        faces: [6, R, R, 3] float32, as in Sky.
        matrix: [3, 3] float32 ``R_world_camera K^-1``, maps (x, y, 1) [px] to directions.
        rgb: [H, W, 3] float32, added to.
        alpha: [H, W] float32.
    """
    height, width = alpha.shape
    for row in prange(height):
        y = F32(row) + HALF
        for column in range(width):
            if alpha[row, column] < OPAQUE:
                direction = pixel_direction(matrix, F32(column) + HALF, y)
                add_sample(faces, direction, rgb, alpha, row, column)


@inlined()
def pixel_direction(matrix, x, y):
    """World direction through (x, y) [px]."""
    return (
        x * matrix[0, 0] + y * matrix[0, 1] + matrix[0, 2],
        x * matrix[1, 0] + y * matrix[1, 1] + matrix[1, 2],
        x * matrix[2, 0] + y * matrix[2, 1] + matrix[2, 2],
    )


@inlined()
def add_sample(faces, direction, rgb, alpha, y, x):
    """Add the bilinear sample along ``direction`` behind one pixel."""
    weight = ONE - alpha[y, x]
    face, row, column = texel_coordinates(direction, faces.shape[1])
    for k in range(3):
        rgb[y, x, k] += weight * bilinear(faces[face], row, column, k)


@inlined()
def texel_coordinates(direction, size):
    """Face index, and row and column in texels of its ``size``, held inside their centres."""
    face, u, v = face_coordinates(direction)
    limit = F32(size - 1)
    column = min(max((u + ONE) / F32(2) * F32(size) - HALF, ZERO), limit)
    row = min(max((v + ONE) / F32(2) * F32(size) - HALF, ZERO), limit)
    return face, row, column


@inlined()
def bilinear(face, row, column, k):
    """Channel ``k`` of a face [R, R, 3] between its texels."""
    c0, r0 = np.int64(math.floor(column)), np.int64(math.floor(row))
    c1, r1 = min(c0 + 1, face.shape[0] - 1), min(r0 + 1, face.shape[0] - 1)
    fc, fr = column - F32(c0), row - F32(r0)
    top = face[r0, c0, k] * (ONE - fc) + face[r0, c1, k] * fc
    bottom = face[r1, c0, k] * (ONE - fc) + face[r1, c1, k] * fc
    return top * (ONE - fr) + bottom * fr


@inlined()
def face_coordinates(direction):
    """Face index and u, v in [-1, 1]; see scene.sky.face_coordinates."""
    x, y, z = direction
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        if x > ZERO:
            return 0, -y / ax, -z / ax
        return 1, y / ax, -z / ax
    if ay >= az:
        if y > ZERO:
            return 2, x / ay, -z / ay
        return 3, -x / ay, -z / ay
    if z > ZERO:
        return 4, -y / az, x / az
    return 5, -y / az, -x / az
