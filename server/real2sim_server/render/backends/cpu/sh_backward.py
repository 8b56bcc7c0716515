"""Gradients of view-dependent colour by the spherical harmonics and by the viewing direction."""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np

from .kernel import inlined
from .project import FASTMATH

F32 = np.float32
ZERO, ONE, TWO, THREE, FIVE = F32(0), F32(1), F32(2), F32(3), F32(5)
C0, C1, C2 = F32(0.2820947917738781), F32(0.48860251190292), F32(1.092548430592079)
C20, C21, C22 = F32(0.9461746957575601), F32(0.3153915652525201), F32(0.5462742152960395)
C30, C31, C32 = F32(-0.5900435899266435), F32(2.890611442640554), F32(-0.4570457994644658)
C33, C34 = F32(0.3731763325901154), F32(1.445305721320277)


@inlined(fastmath=FASTMATH)
def color_backward(cluster, i, r, g, b, out):
    """Add the gradients by the coefficients of Gaussian ``i`` to ``out`` [K, 3].

    Args:
        r, g, b: loss gradient by its colour before the offset.

    Returns:
        Gradient by ``scale * mean - camera_position``, three numbers.
    """
    bands = cluster.sh.shape[1]
    add_coefficient(out, 0, C0, r, g, b)
    if bands == 1:
        return ZERO, ZERO, ZERO
    x = cluster.scale[0] * cluster.means[i, 0] - cluster.camera_position[0]
    y = cluster.scale[1] * cluster.means[i, 1] - cluster.camera_position[1]
    z = cluster.scale[2] * cluster.means[i, 2] - cluster.camera_position[2]
    inverse = ONE / math.sqrt(max(x * x + y * y + z * z, F32(1e-24)))
    x, y, z = x * inverse, y * inverse, z * inverse
    sh = cluster.sh[i]
    add_coefficient(out, 1, -C1 * y, r, g, b)
    add_coefficient(out, 2, C1 * z, r, g, b)
    add_coefficient(out, 3, -C1 * x, r, g, b)
    by_x, by_y = -C1 * weigh(sh, 3, r, g, b), -C1 * weigh(sh, 1, r, g, b)
    by_z = C1 * weigh(sh, 2, r, g, b)
    if bands > 4:
        dx, dy, dz = square_backward(sh, x, y, z, r, g, b, out)
        by_x, by_y, by_z = by_x + dx, by_y + dy, by_z + dz
    if bands > 9:
        dx, dy, dz = cubic_backward(sh, x, y, z, r, g, b, out)
        by_x, by_y, by_z = by_x + dx, by_y + dy, by_z + dz
    along = by_x * x + by_y * y + by_z * z
    return (by_x - along * x) * inverse, (by_y - along * y) * inverse, (by_z - along * z) * inverse


@inlined(fastmath=FASTMATH)
def square_backward(sh, x, y, z, r, g, b, out):
    """Degree 2: coefficients 4 to 8."""
    add_coefficient(out, 4, C2 * x * y, r, g, b)
    add_coefficient(out, 5, -C2 * y * z, r, g, b)
    add_coefficient(out, 6, C20 * z * z - C21, r, g, b)
    add_coefficient(out, 7, -C2 * x * z, r, g, b)
    add_coefficient(out, 8, C22 * (x * x - y * y), r, g, b)
    v4, v5, v6 = weigh(sh, 4, r, g, b), weigh(sh, 5, r, g, b), weigh(sh, 6, r, g, b)
    v7, v8 = weigh(sh, 7, r, g, b), weigh(sh, 8, r, g, b)
    return (
        C2 * (y * v4 - z * v7) + TWO * C22 * x * v8,
        C2 * (x * v4 - z * v5) - TWO * C22 * y * v8,
        TWO * C20 * z * v6 - C2 * (y * v5 + x * v7),
    )


@inlined(fastmath=FASTMATH)
def cubic_backward(sh, x, y, z, r, g, b, out):
    """Degree 3: coefficients 9 to 15."""
    xx, yy, zz = x * x, y * y, z * z
    add_coefficient(out, 9, C30 * y * (THREE * xx - yy), r, g, b)
    add_coefficient(out, 10, C31 * x * y * z, r, g, b)
    add_coefficient(out, 11, C32 * y * (FIVE * zz - ONE), r, g, b)
    add_coefficient(out, 12, C33 * z * (FIVE * zz - THREE), r, g, b)
    add_coefficient(out, 13, C32 * x * (FIVE * zz - ONE), r, g, b)
    add_coefficient(out, 14, C34 * z * (xx - yy), r, g, b)
    add_coefficient(out, 15, C30 * x * (xx - THREE * yy), r, g, b)
    v9, v10, v11 = weigh(sh, 9, r, g, b), weigh(sh, 10, r, g, b), weigh(sh, 11, r, g, b)
    v12, v13 = weigh(sh, 12, r, g, b), weigh(sh, 13, r, g, b)
    v14, v15 = weigh(sh, 14, r, g, b), weigh(sh, 15, r, g, b)
    six, ten, fifteen = F32(6), F32(10), F32(15)
    ring = C32 * (FIVE * zz - ONE)
    waist = THREE * C30 * (xx - yy)
    by_x = six * C30 * x * y * v9 + C31 * y * z * v10 + ring * v13 + TWO * C34 * x * z * v14
    by_y = waist * v9 + C31 * x * z * v10 + ring * v11 - TWO * C34 * y * z * v14
    by_z = C31 * x * y * v10 + C33 * (fifteen * zz - THREE) * v12 + C34 * (xx - yy) * v14
    return (
        by_x + waist * v15,
        by_y - six * C30 * x * y * v15,
        by_z + ten * C32 * z * (y * v11 + x * v13),
    )


@inlined(fastmath=FASTMATH)
def add_coefficient(out, k, basis, r, g, b):
    """Gradient by coefficient ``k``."""
    out[k, 0] += basis * r
    out[k, 1] += basis * g
    out[k, 2] += basis * b


@inlined(fastmath=FASTMATH)
def weigh(sh, k, r, g, b):
    """Gradient by the value of basis function ``k``."""
    return sh[k, 0] * r + sh[k, 1] * g + sh[k, 2] * b
