"""Backward projection: from the gradients of records to those of Gaussians and their placement.

One fused pass over the records of a cluster sums the slots, applies the chain rule through
projection and spherical harmonics, and writes the gradients. Intermediate numbers are float64,
because covariances of needles cancel. Each chunk sums the gradients of the placement separately, so
the summation order does not depend on the number of threads.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..._numba import PARALLEL_LOOPS
from .blend_backward import (
    ABS_X,
    ABS_Y,
    SLOT,
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
)
from .lanes import inlined, kernel
from .project import FASTMATH
from .records import BLUE, CHUNK, EXPONENT_UNIT, GREEN, MEMBER, RED

F32 = np.float32
ZERO, ONE, TWO, THREE, FIVE = F32(0), F32(1), F32(2), F32(3), F32(5)
C0, C1, C2 = F32(0.2820947917738781), F32(0.48860251190292), F32(1.092548430592079)
C20, C21, C22 = F32(0.9461746957575601), F32(0.3153915652525201), F32(0.5462742152960395)
C30, C31, C32 = F32(-0.5900435899266435), F32(2.890611442640554), F32(-0.4570457994644658)
C33, C34 = F32(0.3731763325901154), F32(1.445305721320277)


@inlined(fastmath=FASTMATH)
def color_backward(cluster, i, r, g, b, out):
    """Add the gradients of the coefficients of Gaussian ``i`` to ``out`` [K, 3].

    Args:
        r, g, b: loss gradient with respect to the colour before the offset.

    Returns:
        Gradient with respect to ``scale * mean - camera_position``, three numbers.
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
    """Add the gradients of the coefficients of degree 2: 4 to 8."""
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
    """Add the gradients of the coefficients of degree 3: 9 to 15."""
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
    """Add the gradient of coefficient ``k``."""
    out[k, 0] += basis * r
    out[k, 1] += basis * g
    out[k, 2] += basis * b


@inlined(fastmath=FASTMATH)
def weigh(sh, k, r, g, b):
    """Gradient with respect to the value of basis function ``k``."""
    return sh[k, 0] * r + sh[k, 1] * g + sh[k, 2] * b


# Backward projection


F64 = np.float64
PLACEMENT = 15
"""Number of values of a placement: ``linear`` by rows, ``offset``, ``camera_position``."""
UNIT = EXPONENT_UNIT


class Gradients(NamedTuple):
    """Accumulated loss gradients with respect to the arrays of one cluster.

    If the cluster has covariances, ``covars`` replaces ``quats`` and ``scales``; else it is
    [0, 3, 3].

    Attributes:
        screen: [N, 2], see ScreenStatistics.gradients; [0, 2] if not requested.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    sh: NDArray[np.float32]
    covars: NDArray[np.float32]
    screen: NDArray[np.float32]


class SlotSums(NamedTuple):
    """Gradients written by the tiles; see blend_tiles_backward and scatter_slots."""

    gradients: NDArray[np.float32]
    used: NDArray[np.uint8]
    spans: NDArray[np.int32]


@kernel(parallel=PARALLEL_LOOPS)
def project_backward(cluster, view, base, records, slots, screen_scale, out, placement):
    """Add the gradients of one cluster as seen by one camera.

    Args:
        cluster, view, base, records: arguments and result of project_cluster.
        slots: SlotSums.
        screen_scale: factors on the gradients of x and y [px] in ``out.screen``.
        out: Gradients.
        placement: [chunks, PLACEMENT] float64, written.
    """
    for chunk in prange(placement.shape[0]):
        total = np.empty(SLOT, np.float64)
        sums = placement[chunk]
        chunk_backward(cluster, view, base, chunk, records, slots, screen_scale, out, total, sums)


@kernel(fastmath=FASTMATH)
def project_small_backward(cluster, view, base, records, slots, screen_scale, out, placement):
    """Like project_backward for a single chunk, without threads, whose start would take longer."""
    total = np.empty(SLOT, np.float64)
    sums = placement[0]
    chunk_backward(cluster, view, base, 0, records, slots, screen_scale, out, total, sums)


@inlined(fastmath=FASTMATH)
def chunk_backward(cluster, view, base, chunk, records, slots, screen_scale, out, total, sums):
    """Process one chunk; ``total`` [SLOT] is work space, ``sums`` [PLACEMENT] is written."""
    first = base + chunk * CHUNK
    sums[:] = 0
    for index in range(first, first + records.counts[first // CHUNK]):
        if sum_slots(slots, index, total):
            record = records.values[index]
            i = chunk * CHUNK + np.int64(record[MEMBER])
            gaussian_backward(cluster, view, i, record, total, screen_scale, out, sums)


@inlined()
def sum_slots(slots, index, total):
    """Sum the slots of one record; returns whether any was used."""
    any_used = False
    total[:] = 0
    for slot in range(slots.spans[index, 0], slots.spans[index, 1]):
        if slots.used[slot]:
            any_used = True
            for k in range(SLOT):
                total[k] += F64(slots.gradients[slot, k])
    return any_used


@inlined(fastmath=FASTMATH)
def gaussian_backward(cluster, view, i, record, total, screen_scale, out, placement):
    """Apply the chain rule through the projection to the gradients of one record."""
    m, t = cluster.linear, cluster.offset
    mean = F64(cluster.means[i, 0]), F64(cluster.means[i, 1]), F64(cluster.means[i, 2])
    x, y, z = (
        m[0, 0] * mean[0] + m[0, 1] * mean[1] + m[0, 2] * mean[2] + t[0],
        m[1, 0] * mean[0] + m[1, 1] * mean[1] + m[1, 2] * mean[2] + t[1],
        m[2, 0] * mean[0] + m[2, 1] * mean[1] + m[2, 2] * mean[2] + t[2],
    )
    rz = 1.0 / z
    free_x, free_y = x * rz, y * rz
    tx = min(max(free_x, F64(view.left)), F64(view.right))
    ty = min(max(free_y, F64(view.top)), F64(view.bottom))
    sx, sy = F64(view.fx) * rz, F64(view.fy) * rz
    a = (
        sx * (m[0, 0] - tx * m[2, 0]),
        sx * (m[0, 1] - tx * m[2, 1]),
        sx * (m[0, 2] - tx * m[2, 2]),
    )
    b = (
        sy * (m[1, 0] - ty * m[2, 0]),
        sy * (m[1, 1] - ty * m[2, 1]),
        sy * (m[1, 2] - ty * m[2, 2]),
    )
    by_mean2d, by_a, by_b = shape_backward(cluster, view, i, a, b, total, screen_scale, out)

    by_tx = -sx * dot(by_a, m[2])
    by_ty = -sy * dot(by_b, m[2])
    by_x, by_y = by_mean2d[0] * sx, by_mean2d[1] * sy
    by_z = total[SUM_DEPTH] - rz * (dot(by_a, a) + dot(by_b, b) + by_x * x + by_y * y)
    if tx == free_x:
        by_x += by_tx * rz
        by_z -= by_tx * tx * rz
    if ty == free_y:
        by_y += by_ty * rz
        by_z -= by_ty * ty * rz
    for k in range(3):
        placement[k] += by_x * mean[k] + sx * by_a[k]
        placement[3 + k] += by_y * mean[k] + sy * by_b[k]
        placement[6 + k] += by_z * mean[k] - sx * tx * by_a[k] - sy * ty * by_b[k]
    placement[9] += by_x
    placement[10] += by_y
    placement[11] += by_z
    by_direction = color_backward(
        cluster,
        i,
        F32(total[SUM_RED]) if record[RED] > 0 else F32(0),
        F32(total[SUM_GREEN]) if record[GREEN] > 0 else F32(0),
        F32(total[SUM_BLUE]) if record[BLUE] > 0 else F32(0),
        out.sh[i],
    )
    for k in range(3):
        placement[12 + k] -= F64(by_direction[k])
        by_mean = m[0, k] * by_x + m[1, k] * by_y + m[2, k] * by_z
        out.means[i, k] += F32(by_mean + F64(cluster.scale[k]) * F64(by_direction[k]))


@inlined(fastmath=FASTMATH)
def shape_backward(cluster, view, i, a, b, total, screen_scale, out):
    """Add the gradients of opacity, scales and rotation of one record.

    Args:
        a, b: rows of the map from the cluster frame to the image.

    Returns:
        Gradients with respect to the centre on the image (x, y), ``a`` and ``b``.
    """
    if cluster.covars.shape[0] > 0:
        covar = cluster.covars[i]
        p, q = multiply(covar, a), multiply(covar, b)
        xx, xy, yy = dot(a, p), dot(a, q), dot(b, q)
        by_xx, by_xy, by_yy, by_sharp, by_mean2d = conic_backward(
            cluster, view, i, xx, xy, yy, xx * yy - xy * xy, total, screen_scale, out
        )
        by_xx, by_xy, by_yy = (
            by_xx + by_sharp * yy,
            by_xy - 2.0 * by_sharp * xy,
            by_yy + by_sharp * xx,
        )
        for row in range(3):
            for column in range(3):
                out.covars[i, row, column] += F32(
                    by_xx * a[row] * a[column]
                    + 0.5 * by_xy * (a[row] * b[column] + b[row] * a[column])
                    + by_yy * b[row] * b[column]
                )
        by_a = combine(2.0 * by_xx, p, by_xy, q)
        return by_mean2d, by_a, combine(2.0 * by_yy, q, by_xy, p)

    rotation, norm = rotation_of(cluster.quats[i])
    s = F64(cluster.scales[i, 0]), F64(cluster.scales[i, 1]), F64(cluster.scales[i, 2])
    p, q = turn_back(rotation, a), turn_back(rotation, b)
    u = s[0] * p[0], s[1] * p[1], s[2] * p[2]
    v = s[0] * q[0], s[1] * q[1], s[2] * q[2]
    c = cross(u, v)
    by_xx, by_xy, by_yy, by_sharp, by_mean2d = conic_backward(
        cluster, view, i, dot(u, u), dot(u, v), dot(v, v), dot(c, c), total, screen_scale, out
    )
    vc, cu = cross(v, c), cross(c, u)
    by_u = combine3(2.0 * by_xx, u, by_xy, v, 2.0 * by_sharp, vc)
    by_v = combine3(2.0 * by_yy, v, by_xy, u, 2.0 * by_sharp, cu)
    for k in range(3):
        out.scales[i, k] += F32(by_u[k] * p[k] + by_v[k] * q[k])
    by_p = s[0] * by_u[0], s[1] * by_u[1], s[2] * by_u[2]
    by_q = s[0] * by_v[0], s[1] * by_v[1], s[2] * by_v[2]
    quaternion_backward(cluster.quats[i], norm, a, b, by_p, by_q, out.quats[i])
    return by_mean2d, turn(rotation, by_p), turn(rotation, by_q)


@inlined(fastmath=FASTMATH)
def conic_backward(cluster, view, i, xx, xy, yy, sharp, total, screen_scale, out):
    """Gradients with respect to the opacity of one record and its covariance before blur.

    Args:
        xx, xy, yy, sharp: covariance on the image [px^2] and its determinant before blur.

    Returns:
        Gradients with respect to xx, xy, yy and the determinant, as four independent variables,
        and to the centre on the image (x, y).
    """
    eps = F64(view.eps2d)
    determinant = sharp + eps * (xx + yy) + eps * eps
    blurred = yy + eps
    steep = blurred / (2.0 * UNIT * determinant)
    falloff = 1.0 / (2.0 * UNIT * blurred)
    slope = xy / blurred
    by_mean_x = 2.0 * UNIT * steep * total[SUM_X]
    by_mean_y = 2.0 * UNIT * (falloff * total[SUM_Y] - steep * slope * total[SUM_X])
    by_steep, by_falloff = -UNIT * total[SUM_XX], -UNIT * total[SUM_YY]
    by_slope = 2.0 * UNIT * steep * total[SUM_XY]

    by_determinant = -by_steep * steep / determinant
    by_sharp = 0.0
    if view.antialiased > 0:
        by_determinant -= 0.5 * total[SUM_1] / determinant
        by_sharp = 0.5 * total[SUM_1] / sharp
    by_yy = (by_steep * steep - by_falloff * falloff - by_slope * slope) / blurred
    out.opacities[i] += F32(total[SUM_1] / F64(cluster.opacities[i]))
    if out.screen.shape[0] > 0:
        absolute_x = 2.0 * UNIT * steep * total[ABS_X]
        absolute_y = 2.0 * UNIT * total[ABS_Y]
        out.screen[i, 0] += length(screen_scale[0] * by_mean_x, screen_scale[1] * by_mean_y)
        out.screen[i, 1] += length(screen_scale[0] * absolute_x, screen_scale[1] * absolute_y)
    return (
        eps * by_determinant,
        by_slope / blurred,
        by_yy + eps * by_determinant,
        by_sharp + by_determinant,
        (by_mean_x, by_mean_y),
    )


@inlined(fastmath=FASTMATH)
def rotation_of(quat):
    """Rotation matrix of a quaternion (w, x, y, z) of any length, and the quaternion's length."""
    w, x, y, z = F64(quat[0]), F64(quat[1]), F64(quat[2]), F64(quat[3])
    square = w * w + x * x + y * y + z * z
    n = 2.0 / square
    return (
        1.0 - n * (y * y + z * z),
        n * (x * y - w * z),
        n * (x * z + w * y),
        n * (x * y + w * z),
        1.0 - n * (x * x + z * z),
        n * (y * z - w * x),
        n * (x * z - w * y),
        n * (y * z + w * x),
        1.0 - n * (x * x + y * y),
    ), math.sqrt(square)


@inlined(fastmath=FASTMATH)
def quaternion_backward(quat, norm, a, b, by_p, by_q, out):
    """Add the gradient of a quaternion with length ``norm``.

    The gradient of the rotation is ``a by_p^T + b by_q^T``.
    """
    inverse = 1.0 / norm
    w, x, y, z = (
        F64(quat[0]) * inverse,
        F64(quat[1]) * inverse,
        F64(quat[2]) * inverse,
        F64(quat[3]) * inverse,
    )
    g00, g01, g02 = outer(a[0], b[0], by_p, by_q)
    g10, g11, g12 = outer(a[1], b[1], by_p, by_q)
    g20, g21, g22 = outer(a[2], b[2], by_p, by_q)
    by_w = 2.0 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01))
    by_x = 2.0 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2.0 * x * (g11 + g22))
    by_y = 2.0 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2.0 * y * (g00 + g22))
    by_z = 2.0 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2.0 * z * (g00 + g11))
    along = w * by_w + x * by_x + y * by_y + z * by_z
    out[0] += F32((by_w - along * w) * inverse)
    out[1] += F32((by_x - along * x) * inverse)
    out[2] += F32((by_y - along * y) * inverse)
    out[3] += F32((by_z - along * z) * inverse)


@inlined(fastmath=FASTMATH)
def outer(a, b, p, q):
    """One row of a p^T + b q^T."""
    return a * p[0] + b * q[0], a * p[1] + b * q[1], a * p[2] + b * q[2]


@inlined(fastmath=FASTMATH)
def turn(r, v):
    """R v."""
    return (
        r[0] * v[0] + r[1] * v[1] + r[2] * v[2],
        r[3] * v[0] + r[4] * v[1] + r[5] * v[2],
        r[6] * v[0] + r[7] * v[1] + r[8] * v[2],
    )


@inlined(fastmath=FASTMATH)
def turn_back(r, v):
    """R^T v."""
    return (
        r[0] * v[0] + r[3] * v[1] + r[6] * v[2],
        r[1] * v[0] + r[4] * v[1] + r[7] * v[2],
        r[2] * v[0] + r[5] * v[1] + r[8] * v[2],
    )


@inlined(fastmath=FASTMATH)
def multiply(s, v):
    """S v for a symmetric S [3, 3]; only the upper half is read."""
    return (
        F64(s[0, 0]) * v[0] + F64(s[0, 1]) * v[1] + F64(s[0, 2]) * v[2],
        F64(s[0, 1]) * v[0] + F64(s[1, 1]) * v[1] + F64(s[1, 2]) * v[2],
        F64(s[0, 2]) * v[0] + F64(s[1, 2]) * v[1] + F64(s[2, 2]) * v[2],
    )


@inlined(fastmath=FASTMATH)
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined(fastmath=FASTMATH)
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined(fastmath=FASTMATH)
def combine(f, a, g, b):
    """f a + g b."""
    return f * a[0] + g * b[0], f * a[1] + g * b[1], f * a[2] + g * b[2]


@inlined(fastmath=FASTMATH)
def combine3(f, a, g, b, h, c):
    """f a + g b + h c."""
    return (
        f * a[0] + g * b[0] + h * c[0],
        f * a[1] + g * b[1] + h * c[1],
        f * a[2] + g * b[2] + h * c[2],
    )


@inlined(fastmath=FASTMATH)
def length(x, y):
    """Length of a vector, float32."""
    return F32(math.sqrt(x * x + y * y))
