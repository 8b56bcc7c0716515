"""Projection of one cluster of Gaussians onto one image, fused with culling and colour.

Nothing of the cluster is copied: what may be seen becomes one record, eight Gaussians at a time.
Chunks of fixed size write to regions of their own, so that the result does not depend on the
number of threads.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS
from .footprint import footprints_of_eight
from .kernel import inlined, kernel
from .lanes import LANES
from .project_lanes import (
    MEAN,
    OPACITY,
    PROJECTION,
    SHAPE,
    place_eight,
    place_eight_deformed,
    shape_eight,
    shape_eight_deformed,
)
from .records import BLUE, CHUNK, DEPTH, GREEN, INSTANCE, MEMBER, RECORD, RED
from .simd import lowest_bit

F32 = np.float32
ZERO, HALF, ONE, TWO = F32(0), F32(0.5), F32(1), F32(2)
FIELDS = tuple(
    field for field in range(RECORD) if field not in {RED, GREEN, BLUE, INSTANCE, MEMBER}
)
"""Fields of a record that come from the planes of eight."""
FASTMATH = {"contract", "nsz", "arcp"}


@kernel(parallel=PARALLEL_LOOPS, fastmath=FASTMATH)
def project_cluster(cluster, view, base, chunks, records):
    """Write records of those Gaussians of one Cluster that a CameraParameters may see.

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
        planes = np.empty(PROJECTION * LANES, np.float32)
        found = np.empty(LANES, np.int64)
        counts[first // CHUNK] = project_chunk(
            cluster, view, start, planes, found, values, footprints, depths, first
        )


@kernel(fastmath=FASTMATH)
def project_small_cluster(cluster, view, base, chunks, records):
    """Like project_cluster for one chunk, where waking threads would take longer than the work."""
    values, footprints, depths = records.values, records.footprints, records.depths
    start = chunks[0] * CHUNK
    planes = np.empty(PROJECTION * LANES, np.float32)
    found = np.empty(LANES, np.int64)
    records.counts[base // CHUNK] = project_chunk(
        cluster, view, start, planes, found, values, footprints, depths, base
    )


@inlined(fastmath=FASTMATH)
def project_chunk(cluster, view, start, planes, found, values, footprints, depths, first):
    """Write the records of CHUNK Gaussians from ``start`` on to the region from ``first`` on.

    Args:
        planes, found: work space, see :mod:`.project_lanes` and footprints_of_eight.

    Returns:
        Records written.
    """
    slot = first
    stop = min(cluster.means.shape[0], start + CHUNK)
    for eight in range(start, stop, LANES):
        lanes = project_eight(cluster, view, eight, min(stop - eight, LANES), planes, found)
        while lanes != 0:
            lane = lowest_bit(lanes)
            lanes &= lanes - 1
            out = values[slot]
            for field in FIELDS:
                out[field] = planes[field * LANES + lane]
            out[INSTANCE] = cluster.instance_id
            out[MEMBER] = F32(eight + lane - start)
            write_color(cluster, eight + lane, out)
            footprints[slot] = found[lane]
            depths[slot] = out[DEPTH]
            slot += 1
    return slot - first


@inlined()
def project_eight(cluster, view, first, count, planes, found):
    """Project ``count`` Gaussians from ``first`` on; returns bits of those to be recorded."""
    gather_eight(cluster, first, count, planes)
    lanes = np.int64((1 << count) - 1)
    if cluster.covars.shape[0] > 0:
        lanes = place_eight_deformed(planes, lanes, view, cluster)
        if lanes != 0:
            lanes = shape_eight_deformed(planes, lanes, view, cluster)
    else:
        lanes = place_eight(planes, lanes, view, cluster)
        if lanes != 0:
            lanes = shape_eight(planes, lanes, view, cluster)
    if lanes != 0:
        lanes = footprints_of_eight(planes, lanes, view, found)
    return lanes


@inlined()
def gather_eight(cluster, first, count, planes):
    """Lay ``count`` Gaussians side by side in the planes."""
    for lane in range(count):
        gather_lane(cluster, first + lane, lane, planes)


@inlined()
def gather_lane(cluster, i, lane, planes):
    """Lay Gaussian ``i`` into a lane of the planes."""
    for k in range(3):
        planes[(MEAN + k) * LANES + lane] = cluster.means[i, k]
    planes[OPACITY * LANES + lane] = cluster.opacities[i]
    gather_shape(cluster, i, SHAPE, lane, planes)


@inlined()
def gather_shape(cluster, i, first, lane, planes):
    """Lay the shape of Gaussian ``i`` into a lane of the planes from ``first`` on: the upper half
    of its covariance by rows, or where the cluster has none quaternion and scales."""
    if cluster.covars.shape[0] > 0:
        covar, plane = cluster.covars[i], first * LANES + lane
        for row in range(3):
            for column in range(row, 3):
                planes[plane] = covar[row, column]
                plane += LANES
    else:
        for k in range(4):
            planes[(first + k) * LANES + lane] = cluster.quats[i, k]
        for k in range(3):
            planes[(first + 4 + k) * LANES + lane] = cluster.scales[i, k]


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
