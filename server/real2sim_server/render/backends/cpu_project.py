"""Projection of one cluster of Gaussians onto one image, fused with culling and colour.

Nothing of the cluster is copied: what may be seen becomes one record. Chunks of fixed size write
to regions of their own, so that the result does not depend on the number of threads.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange

from .base import ALPHA_MIN
from .cpu_footprint import NOWHERE, footprint_of
from .cpu_records import (
    BLUE,
    CHUNK,
    DEPTH,
    EXPONENT_UNIT,
    EXTENT_X,
    EXTENT_Y,
    FALLOFF,
    GREEN,
    INSTANCE,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    MEMBER,
    RED,
    SHARPNESS,
    SLOPE,
    TIP_Y,
)
from .kernel import inlined, kernel

F32 = np.float32
ZERO, HALF, ONE, TWO = F32(0), F32(0.5), F32(1), F32(2)
LEAST_ALPHA = F32(ALPHA_MIN)
REACH_MAX = F32(math.sqrt(2 * math.log(255.0)))
LOG_255 = F32(math.log(255.0))
HALF_UNIT = F32(0.5 / EXPONENT_UNIT)
COVARIANCE_MAX = F32(1e30)
"""Larger than any picture [px^2]; beyond it float32 gives out."""
FASTMATH = {"contract", "nsz", "arcp"}


@kernel(parallel=True, fastmath=FASTMATH)
def project_cluster(cluster, view, base, chunks, records):
    """Write records of those Gaussians of one Cluster that a View may see.

    Args:
        base: first record of this cluster, a multiple of CHUNK.
        chunks: [K] int64, numbers of the chunks to look at.
        records: Records, K regions from ``base`` on are written.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    values, footprints = records.values, records.footprints
    depths, counts = records.depths, records.counts
    for k in prange(chunks.shape[0]):
        first, start = base + k * CHUNK, chunks[k] * CHUNK
        project_chunk(cluster, view, first, start, values, footprints, depths, counts)


@kernel(fastmath=FASTMATH)
def project_small_cluster(cluster, view, base, chunks, records):
    """Like project_cluster for one chunk, where waking threads would take longer than the work."""
    values, footprints = records.values, records.footprints
    start = chunks[0] * CHUNK
    project_chunk(cluster, view, base, start, values, footprints, records.depths, records.counts)


@inlined(fastmath=FASTMATH)
def project_chunk(cluster, view, first, start, values, footprints, depths, counts):
    """Write the records of CHUNK Gaussians from ``start`` on to the region from ``first`` on."""
    slot = first
    for i in range(start, min(cluster.means.shape[0], start + CHUNK)):
        footprint = project_gaussian(cluster, view, i, values, slot)
        if footprint != NOWHERE:
            values[slot, MEMBER] = F32(i - start)
            footprints[slot] = footprint
            depths[slot] = values[slot, DEPTH]
            slot += 1
    counts[first // CHUNK] = slot - first


@inlined(fastmath=FASTMATH)
def project_gaussian(cluster, view, i, values, slot):  # noqa: PLR0911 - each test drops as early as it can
    """Write the record of Gaussian ``i`` to ``slot``; returns its footprint."""
    out = values[slot]
    opacity = cluster.opacities[i]
    if not opacity >= LEAST_ALPHA:
        return NOWHERE
    x, y, z = to_camera(cluster, i)
    if not (z >= view.near_plane and z <= view.far_plane):
        return NOWHERE
    rz = ONE / z
    tx, ty = x * rz, y * rz
    mean_x, mean_y = view.fx * tx + view.cx, view.fy * ty + view.cy
    tx = min(max(tx, view.left), view.right)
    ty = min(max(ty, view.top), view.bottom)
    scale_x, scale_y = view.fx * rz, view.fy * rz
    sigma = largest_sigma(cluster, i)
    reach_x = REACH_MAX * (scale_x * (ONE + abs(tx)) * sigma + view.blur)
    reach_y = REACH_MAX * (scale_y * (ONE + abs(ty)) * sigma + view.blur)
    if not on_image(view, mean_x, mean_y, reach_x, reach_y):
        return NOWHERE

    cxx, cxy, cyy, sharp = image_covariance(cluster, i, scale_x, scale_y, tx, ty)
    determinant = sharp + view.eps2d * (cxx + cyy) + view.eps2d * view.eps2d
    cxx += view.eps2d
    cyy += view.eps2d
    if not (determinant > ZERO and cxx < COVARIANCE_MAX and cyy < COVARIANCE_MAX):
        return NOWHERE
    if view.antialiased > ZERO:
        opacity *= F32(math.sqrt(max(sharp, 0.0) / determinant))
        if not opacity >= LEAST_ALPHA:
            return NOWHERE
    level = -math.log(opacity)
    reach = math.sqrt(TWO * max(LOG_255 - level, ZERO))
    reach_x = reach * math.sqrt(F32(cxx))
    reach_y = reach * math.sqrt(F32(cyy))
    clip = view.radius_clip
    if clip > ZERO and math.ceil(reach_x) <= clip and math.ceil(reach_y) <= clip:
        return NOWHERE
    if not on_image(view, mean_x, mean_y, reach_x, reach_y):
        return NOWHERE

    inverse = ONE / F32(cyy)
    out[MEAN_X] = mean_x
    out[MEAN_Y] = mean_y
    out[SHARPNESS] = math.sqrt(F32(cyy / determinant) * HALF_UNIT)
    out[SLOPE] = F32(cxy) * inverse
    out[FALLOFF] = HALF_UNIT * inverse
    out[LEVEL] = level * F32(1 / EXPONENT_UNIT)
    out[DEPTH] = z
    out[INSTANCE] = cluster.instance_id
    out[EXTENT_X] = reach_x
    out[EXTENT_Y] = reach_y
    out[TIP_Y] = reach_x * F32(cxy) / F32(cxx)
    write_color(cluster, i, out)
    return footprint_of(view, out, reach_x, reach_y)


@inlined(fastmath=FASTMATH)
def on_image(view, x, y, reach_x, reach_y):
    """Whether a box about (x, y) meets the image; False for what is not finite."""
    return (
        x + reach_x > ZERO
        and x - reach_x < view.width
        and y + reach_y > ZERO
        and y - reach_y < view.height
    )


@inlined(fastmath=FASTMATH)
def to_camera(cluster, i):
    """Centre in the camera frame; summed in float64 so that rounding cannot change the order."""
    x, y, z = (
        np.float64(cluster.means[i, 0]),
        np.float64(cluster.means[i, 1]),
        np.float64(cluster.means[i, 2]),
    )
    m, t = cluster.linear, cluster.offset
    return (
        F32(m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + t[0]),
        F32(m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + t[1]),
        F32(m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + t[2]),
    )


@inlined(fastmath=FASTMATH)
def largest_sigma(cluster, i):
    """Upper bound of the standard deviation along any direction of the world [m]."""
    largest = max(cluster.scale[0], cluster.scale[1], cluster.scale[2])
    if cluster.covars.shape[0] > 0:
        trace = cluster.covars[i, 0, 0] + cluster.covars[i, 1, 1] + cluster.covars[i, 2, 2]
        return math.sqrt(trace) * largest
    s = cluster.scales[i]
    return largest * max(s[0], s[1], s[2])


@inlined(fastmath=FASTMATH)
def image_covariance(cluster, i, scale_x, scale_y, tx, ty):
    """Covariance (xx, xy, yy) [px^2] on the image before blur, and its determinant, float64."""
    m = cluster.linear
    ax = scale_x * (F32(m[0, 0]) - tx * F32(m[2, 0]))
    ay = scale_x * (F32(m[0, 1]) - tx * F32(m[2, 1]))
    az = scale_x * (F32(m[0, 2]) - tx * F32(m[2, 2]))
    bx = scale_y * (F32(m[1, 0]) - ty * F32(m[2, 0]))
    by = scale_y * (F32(m[1, 1]) - ty * F32(m[2, 1]))
    bz = scale_y * (F32(m[1, 2]) - ty * F32(m[2, 2]))
    if cluster.covars.shape[0] > 0:
        return transform_covariance(cluster.covars[i], ax, ay, az, bx, by, bz)
    w, x, y, z = cluster.quats[i, 0], cluster.quats[i, 1], cluster.quats[i, 2], cluster.quats[i, 3]
    norm = TWO / (w * w + x * x + y * y + z * z)
    s0, s1, s2 = cluster.scales[i, 0], cluster.scales[i, 1], cluster.scales[i, 2]
    xx, yy, zz = x * x * norm, y * y * norm, z * z * norm
    xy, xz, yz = x * y * norm, x * z * norm, y * z * norm
    wx, wy, wz = w * x * norm, w * y * norm, w * z * norm
    u0 = np.float64(s0 * (ax * (ONE - yy - zz) + ay * (xy + wz) + az * (xz - wy)))
    u1 = np.float64(s1 * (ax * (xy - wz) + ay * (ONE - xx - zz) + az * (yz + wx)))
    u2 = np.float64(s2 * (ax * (xz + wy) + ay * (yz - wx) + az * (ONE - xx - yy)))
    v0 = np.float64(s0 * (bx * (ONE - yy - zz) + by * (xy + wz) + bz * (xz - wy)))
    v1 = np.float64(s1 * (bx * (xy - wz) + by * (ONE - xx - zz) + bz * (yz + wx)))
    v2 = np.float64(s2 * (bx * (xz + wy) + by * (yz - wx) + bz * (ONE - xx - yy)))
    # Lagrange's identity: |u|^2 |v|^2 - (u v)^2 without the cancellation that ruins needles.
    c0, c1, c2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    return (
        u0 * u0 + u1 * u1 + u2 * u2,
        u0 * v0 + u1 * v1 + u2 * v2,
        v0 * v0 + v1 * v1 + v2 * v2,
        c0 * c0 + c1 * c1 + c2 * c2,
    )


@inlined(fastmath=FASTMATH)
def transform_covariance(covar, ax, ay, az, bx, by, bz):
    """Like image_covariance, from rows a, b of the map and a covariance [3, 3]."""
    sxx, sxy, sxz = np.float64(covar[0, 0]), np.float64(covar[0, 1]), np.float64(covar[0, 2])
    syy, syz, szz = np.float64(covar[1, 1]), np.float64(covar[1, 2]), np.float64(covar[2, 2])
    px, py, pz = (
        sxx * ax + sxy * ay + sxz * az,
        sxy * ax + syy * ay + syz * az,
        sxz * ax + syz * ay + szz * az,
    )
    xx, xy = px * ax + py * ay + pz * az, px * bx + py * by + pz * bz
    yy = (
        bx * (sxx * bx + sxy * by + sxz * bz)
        + by * (sxy * bx + syy * by + syz * bz)
        + bz * (sxz * bx + syz * by + szz * bz)
    )
    return xx, xy, yy, xx * yy - xy * xy


@inlined(fastmath=FASTMATH)
def write_color(cluster, i, out):
    """Evaluate the spherical harmonics of Gaussian ``i`` as seen by the camera (Sloan 2013)."""
    sh = cluster.sh[i]
    bands = cluster.sh.shape[1]
    c0 = F32(0.2820947917738781)
    r, g, b = sh[0, 0], sh[0, 1], sh[0, 2]
    for k in range(cluster.tones.shape[0]):
        tone = cluster.tones[k]
        r += tone * cluster.coefficients[i, k, 0]
        g += tone * cluster.coefficients[i, k, 1]
        b += tone * cluster.coefficients[i, k, 2]
    r, g, b = c0 * r + HALF, c0 * g + HALF, c0 * b + HALF
    if bands > 1:
        x = cluster.scale[0] * cluster.means[i, 0] - cluster.camera_position[0]
        y = cluster.scale[1] * cluster.means[i, 1] - cluster.camera_position[1]
        z = cluster.scale[2] * cluster.means[i, 2] - cluster.camera_position[2]
        inverse = ONE / math.sqrt(max(x * x + y * y + z * z, F32(1e-24)))
        x, y, z = x * inverse, y * inverse, z * inverse
        c1 = F32(0.48860251190292)
        r, g, b = add_band(r, g, b, sh, 1, -c1 * y)
        r, g, b = add_band(r, g, b, sh, 2, c1 * z)
        r, g, b = add_band(r, g, b, sh, 3, -c1 * x)
        if bands > 4:
            c2 = F32(1.092548430592079)
            r, g, b = add_band(r, g, b, sh, 4, c2 * x * y)
            r, g, b = add_band(r, g, b, sh, 5, -c2 * y * z)
            r, g, b = add_band(
                r, g, b, sh, 6, F32(0.9461746957575601) * z * z - F32(0.3153915652525201)
            )
            r, g, b = add_band(r, g, b, sh, 7, -c2 * x * z)
            r, g, b = add_band(r, g, b, sh, 8, F32(0.5462742152960395) * (x * x - y * y))
            if bands > 9:
                r, g, b = add_cubic(r, g, b, sh, x, y, z)
    out[RED], out[GREEN], out[BLUE] = max(r, ZERO), max(g, ZERO), max(b, ZERO)


@inlined(fastmath=FASTMATH)
def add_cubic(r, g, b, sh, x, y, z):
    """Add the seven functions of degree 3."""
    five, three = F32(5) * z * z - ONE, F32(3)
    c3, c5 = F32(-0.5900435899266435), F32(-0.4570457994644658)
    r, g, b = add_band(r, g, b, sh, 9, c3 * y * (three * x * x - y * y))
    r, g, b = add_band(r, g, b, sh, 10, F32(2.890611442640554) * x * y * z)
    r, g, b = add_band(r, g, b, sh, 11, c5 * y * five)
    r, g, b = add_band(r, g, b, sh, 12, F32(0.3731763325901154) * z * (five - TWO))
    r, g, b = add_band(r, g, b, sh, 13, c5 * x * five)
    r, g, b = add_band(r, g, b, sh, 14, F32(1.445305721320277) * z * (x * x - y * y))
    return add_band(r, g, b, sh, 15, c3 * x * (x * x - three * y * y))


@inlined(fastmath=FASTMATH)
def add_band(r, g, b, sh, k, basis):
    """Colour plus coefficient ``k`` times its basis function."""
    return r + basis * sh[k, 0], g + basis * sh[k, 1], b + basis * sh[k, 2]
