"""Depth of a pixel's front: where its ray meets that Gaussian most.

The centre of a Gaussian may lie decimetres before or behind what a pixel shows of it: discs on a
road reach far along the view. The response along a ray is largest where the ray is nearest to the
centre in the Gaussian's own measure (Moenne-Loccoz et al. 2024), blurred as its image is.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .kernel import inlined, kernel
from .records import CHUNK, DEPTH, INSTANCE, MEMBER

F32 = np.float32
SHAPE = 16
"""Centre in the camera's frame [m], inverse of the covariance, xx, yy, zz, xy, xz, yz, and the
object: one cache line."""
OBJECT = 9


@kernel(parallel=PARALLEL_LOOPS)
def shape_fronts(cluster, view, base, chunks, values, counts, used, shapes):
    """Write the shapes of those records of one Cluster that are a front.

    Args:
        cluster, view, base, chunks: as of project_cluster.
        values, counts: of Records.
        used: [1 + M] uint8, not 0 where record m is a front, at 1 + m.
        shapes: [M, SHAPE] float32, written.
    """
    for k in prange(chunks.shape[0]):
        first = base + k * CHUNK
        for slot in range(first, first + counts[first // CHUNK]):
            if used[1 + slot]:
                member = np.int64(values[slot, MEMBER])
                write_shape(cluster, view, chunks[k] * CHUNK + member, shapes[slot])
                shapes[slot, OBJECT] = cluster.instance_id


@inlined()
def write_shape(cluster, view, i, out):
    """The shape of Gaussian ``i`` in the camera's frame."""
    a, mean = cluster.linear, cluster.means[i]
    xx, yy, zz, xy, xz, yz = covariance_of(cluster, i)
    for k in range(3):
        out[k] = F32(a[k, 0] * mean[0] + a[k, 1] * mean[1] + a[k, 2] * mean[2] + cluster.offset[k])
    # As much as the image is blurred, so that discs seen from the side have a depth too.
    blur = np.float64(view.blur) * out[2] / np.float64(view.fx)
    blur *= blur
    cxx = along(a, 0, 0, xx, yy, zz, xy, xz, yz) + blur
    cyy = along(a, 1, 1, xx, yy, zz, xy, xz, yz) + blur
    czz = along(a, 2, 2, xx, yy, zz, xy, xz, yz) + blur
    cxy = along(a, 0, 1, xx, yy, zz, xy, xz, yz)
    cxz = along(a, 0, 2, xx, yy, zz, xy, xz, yz)
    cyz = along(a, 1, 2, xx, yy, zz, xy, xz, yz)
    ixx, iyy, izz = cyy * czz - cyz * cyz, cxx * czz - cxz * cxz, cxx * cyy - cxy * cxy
    ixy, ixz, iyz = cxz * cyz - cxy * czz, cxy * cyz - cxz * cyy, cxy * cxz - cxx * cyz
    one = 1.0 / (cxx * ixx + cxy * ixy + cxz * ixz)
    out[3], out[4], out[5] = F32(ixx * one), F32(iyy * one), F32(izz * one)
    out[6], out[7], out[8] = F32(ixy * one), F32(ixz * one), F32(iyz * one)


@inlined()
def along(a, r, s, xx, yy, zz, xy, xz, yz):
    """Entry (r, s) of a covariance carried by ``a``."""
    x = a[s, 0] * xx + a[s, 1] * xy + a[s, 2] * xz
    y = a[s, 0] * xy + a[s, 1] * yy + a[s, 2] * yz
    z = a[s, 0] * xz + a[s, 1] * yz + a[s, 2] * zz
    return a[r, 0] * x + a[r, 1] * y + a[r, 2] * z


@inlined()
def covariance_of(cluster, i):
    """Covariance of Gaussian ``i`` in its cloud's frame: xx, yy, zz, xy, xz, yz."""
    if cluster.covars.shape[0] > 0:
        c = cluster.covars[i]
        return (
            np.float64(c[0, 0]), np.float64(c[1, 1]), np.float64(c[2, 2]),
            np.float64(c[0, 1]), np.float64(c[0, 2]), np.float64(c[1, 2]),
        )  # fmt: skip
    w, x = np.float64(cluster.quats[i, 0]), np.float64(cluster.quats[i, 1])
    y, z = np.float64(cluster.quats[i, 2]), np.float64(cluster.quats[i, 3])
    one = 1.0 / math.sqrt(max(w * w + x * x + y * y + z * z, 1e-24))
    w, x, y, z = w * one, x * one, y * one, z * one
    p, q, r = cluster.scales[i, 0], cluster.scales[i, 1], cluster.scales[i, 2]
    ax, ay, az = (1 - 2 * (y * y + z * z)) * p, 2 * (x * y + w * z) * p, 2 * (x * z - w * y) * p
    bx, by, bz = 2 * (x * y - w * z) * q, (1 - 2 * (x * x + z * z)) * q, 2 * (y * z + w * x) * q
    cx, cy, cz = 2 * (x * z + w * y) * r, 2 * (y * z - w * x) * r, (1 - 2 * (x * x + y * y)) * r
    return (
        ax * ax + bx * bx + cx * cx, ay * ay + by * by + cy * cy, az * az + bz * bz + cz * cz,
        ax * ay + bx * by + cx * cy, ax * az + bx * bz + cx * cz, ay * az + by * bz + cy * cz,
    )  # fmt: skip


@kernel(parallel=PARALLEL_LOOPS)
def read_fronts(fronts, left, top, view, values, shapes, depth, instance):
    """Write depth [m] and object of the fronts of a window [h, w] of the image.

    Args:
        fronts: [h, w] int32, one more than numbers of records, 0 for none.
        left, top: of the window in the image [px].
        shapes: [M, SHAPE]; [0, SHAPE] for the depths of centres.
    """
    inverse_x, inverse_y = F32(1) / view.fx, F32(1) / view.fy
    for row in prange(fronts.shape[0]):
        v = (F32(row + top) + F32(0.5) - view.cy) * inverse_y
        for column in range(fronts.shape[1]):
            front = fronts[row, column]
            if front == 0:
                depth[row, column], instance[row, column] = F32(0), np.uint16(0)
                continue
            if shapes.shape[0]:
                shape = shapes[front - 1]
                u = (F32(column + left) + F32(0.5) - view.cx) * inverse_x
                depth[row, column] = depth_along(shape, u, v, view.near_plane)
                instance[row, column] = np.uint16(shape[OBJECT])
            else:
                record = values[front - 1]
                depth[row, column] = record[DEPTH]
                instance[row, column] = np.uint16(record[INSTANCE])


@inlined()
def depth_along(shape, u, v, nearest):
    """Depth of the largest response along the ray (u, v, 1)."""
    x, y, z = shape[0] - shape[2] * u, shape[1] - shape[2] * v, shape[2]
    # The inverse covariance times the ray.
    a = shape[3] * u + shape[6] * v + shape[7]
    b = shape[6] * u + shape[4] * v + shape[8]
    c = shape[7] * u + shape[8] * v + shape[5]
    return max(z + (a * x + b * y) / (a * u + b * v + c), nearest)
