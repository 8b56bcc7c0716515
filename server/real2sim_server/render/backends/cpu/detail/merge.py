"""Gaussians of one cell of space merged into one that has their moments.

With weight ``tau area`` of each, tau = -ln(1 - opacity) its optical depth and ``area`` what it
covers seen from all around, the merged one has the mean centre, the covariance of all of them
about it, the mean colour, and an opacity by the optical depth that is the sum of the weights over
its own area.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ....._numba import PARALLEL_LOOPS
from ..kernel import inlined, kernel

OPACITY_MIN = 1.0 / 255.0
OPACITY_MAX = 0.999
OPAQUE = 2.0
"""Largest opacity of merged Gaussians."""
EDGE = 0.5 / math.log(2.0)
"""Opacity over optical depth so that half of the light comes through at the same distance."""
MOMENTS = 11
"""Numbers that are summed of a cell: weight, centre, upper half of the covariance, count."""


@kernel()
def upper_half(quats, scales, out):
    """Covariances [N, 6] (xx, xy, xz, yy, yz, zz) of quaternions and standard deviations."""
    for i in range(quats.shape[0]):
        w, x, y, z = (
            np.float64(quats[i, 0]),
            np.float64(quats[i, 1]),
            np.float64(quats[i, 2]),
            np.float64(quats[i, 3]),
        )
        n = 2.0 / max(w * w + x * x + y * y + z * z, 1e-30)
        r00, r01, r02 = 1 - n * (y * y + z * z), n * (x * y - w * z), n * (x * z + w * y)
        r10, r11, r12 = n * (x * y + w * z), 1 - n * (x * x + z * z), n * (y * z - w * x)
        r20, r21, r22 = n * (x * z - w * y), n * (y * z + w * x), 1 - n * (x * x + y * y)
        a = np.float64(scales[i, 0]) ** 2
        b = np.float64(scales[i, 1]) ** 2
        c = np.float64(scales[i, 2]) ** 2
        out[i, 0] = a * r00 * r00 + b * r01 * r01 + c * r02 * r02
        out[i, 1] = a * r00 * r10 + b * r01 * r11 + c * r02 * r12
        out[i, 2] = a * r00 * r20 + b * r01 * r21 + c * r02 * r22
        out[i, 3] = a * r10 * r10 + b * r11 * r11 + c * r12 * r12
        out[i, 4] = a * r10 * r20 + b * r11 * r21 + c * r12 * r22
        out[i, 5] = a * r20 * r20 + b * r21 * r21 + c * r22 * r22


@kernel(parallel=PARALLEL_LOOPS)
def count_merged(codes, order, sizes, opacities, block_starts, shift, largest, counts):
    """How many Gaussians each block has at a level.

    Args:
        codes: [N] int64, places along a Z curve, increasing.
        order: [N] int64, the Gaussian at each place.
        sizes: [N] float32, largest standard deviations [m].
        opacities: [N] float32.
        block_starts: [B + 1] int64, where blocks begin in ``codes``.
        shift: bits of a code within a cell of the level.
        largest: standard deviation above which a Gaussian stays as it is [m].
        counts: [B] int64, written.
    """
    for block in prange(counts.shape[0]):
        found = 0
        cell = np.int64(-1)
        for place in range(block_starts[block], block_starts[block + 1]):
            i = order[place]
            if opacities[i] < OPACITY_MIN:
                continue
            if sizes[i] > largest:
                found += 1
            elif codes[place] >> shift != cell:
                cell = codes[place] >> shift
                found += 1
        counts[block] = found


@kernel(parallel=PARALLEL_LOOPS)
def merge_level(
    codes,
    order,
    sizes,
    block_starts,
    shift,
    largest,
    firsts,
    means,
    covars,
    opacities,
    features,
    out_means,
    out_covars,
    out_opacities,
    out_features,
):
    """Write the Gaussians of a level; arguments as of count_merged.

    Args:
        firsts: [B] int64, where each block writes first.
        means, covars, opacities, features: [N, 3], [N, 6], [N] and [N, F], the originals.
        out_means, out_covars, out_opacities, out_features: [M, 3], [M, 3, 3], [M], [M, F] float32.
    """
    for block in prange(firsts.shape[0]):
        moments = np.zeros(MOMENTS)
        colour = np.zeros(features.shape[1])
        origin = np.zeros(3)
        slot = firsts[block]
        open_slot = np.int64(-1)
        cell = np.int64(-1)
        for place in range(block_starts[block], block_starts[block + 1]):
            i = order[place]
            if opacities[i] < OPACITY_MIN:
                continue
            if sizes[i] > largest:
                copy_one(i, slot, means, covars, opacities, features, out_means, out_covars,
                         out_opacities, out_features)  # fmt: skip
                slot += 1
                continue
            if codes[place] >> shift != cell:
                if open_slot >= 0:
                    close_cell(moments, colour, origin, open_slot, out_means, out_covars,
                               out_opacities, out_features)  # fmt: skip
                cell = codes[place] >> shift
                open_slot = slot
                slot += 1
                moments[:] = 0.0
                colour[:] = 0.0
                for k in range(3):
                    origin[k] = means[i, k]
            add_one(i, means, covars, opacities, features, origin, moments, colour)
        if open_slot >= 0:
            close_cell(moments, colour, origin, open_slot, out_means, out_covars,
                       out_opacities, out_features)  # fmt: skip


@inlined()
def covered_area(xx, xy, xz, yy, yz, zz):
    """Product of the two larger standard deviations [m^2] of what is flat; near it for others."""
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return math.sqrt(max(minors, 1e-24))


@inlined()
def add_one(i, means, covars, opacities, features, origin, moments, colour):
    """Add Gaussian ``i`` to the sums of a cell."""
    opacity = min(np.float64(opacities[i]), OPACITY_MAX)
    c = covars[i]
    weight = -math.log1p(-opacity) * covered_area(c[0], c[1], c[2], c[3], c[4], c[5])
    x, y, z = means[i, 0] - origin[0], means[i, 1] - origin[1], means[i, 2] - origin[2]
    moments[0] += weight
    moments[1] += weight * x
    moments[2] += weight * y
    moments[3] += weight * z
    moments[4] += weight * (c[0] + x * x)
    moments[5] += weight * (c[1] + x * y)
    moments[6] += weight * (c[2] + x * z)
    moments[7] += weight * (c[3] + y * y)
    moments[8] += weight * (c[4] + y * z)
    moments[9] += weight * (c[5] + z * z)
    moments[10] += 1
    for k in range(colour.shape[0]):
        colour[k] += weight * features[i, k]


@inlined()
def close_cell(moments, colour, origin, slot, out_means, out_covars, out_opacities, out_features):
    """Write the Gaussian that has the moments of a cell."""
    weight = max(moments[0], 1e-30)
    x, y, z = moments[1] / weight, moments[2] / weight, moments[3] / weight
    xx, xy = moments[4] / weight - x * x, moments[5] / weight - x * y
    xz, yy = moments[6] / weight - x * z, moments[7] / weight - y * y
    yz, zz = moments[8] / weight - y * z, moments[9] / weight - z * z
    out_means[slot, 0], out_means[slot, 1] = origin[0] + x, origin[1] + y
    out_means[slot, 2] = origin[2] + z
    write_covariance(out_covars, slot, xx, xy, xz, yy, yz, zz)
    depth = weight / covered_area(xx, xy, xz, yy, yz, zz)
    out_opacities[slot] = merged_opacity(depth, moments[10] > 1)
    for k in range(colour.shape[0]):
        out_features[slot, k] = colour[k] / weight


@inlined()
def merged_opacity(depth, several):
    """Opacity of what has an optical depth in its centre.

    Many opaque ones beside each other have no peak but an edge, as has one of an opacity above 1,
    of which blending cuts the top off. From half of it on, their edges are at the same place.
    """
    opacity = min(-math.expm1(-depth), OPACITY_MAX)
    if several:
        return min(max(opacity, depth * EDGE), OPAQUE)
    return opacity


@inlined()
def copy_one(
    i, slot, means, covars, opacities, features, out_means, out_covars, out_opacities, out_features
):
    """Write Gaussian ``i`` as it is."""
    for k in range(3):
        out_means[slot, k] = means[i, k]
    c = covars[i]
    write_covariance(out_covars, slot, c[0], c[1], c[2], c[3], c[4], c[5])
    out_opacities[slot] = opacities[i]
    for k in range(features.shape[1]):
        out_features[slot, k] = features[i, k]


@inlined()
def write_covariance(out, slot, xx, xy, xz, yy, yz, zz):
    """Write a symmetric matrix from its upper half."""
    out[slot, 0, 0], out[slot, 1, 1], out[slot, 2, 2] = xx, yy, zz
    out[slot, 0, 1] = out[slot, 1, 0] = xy
    out[slot, 0, 2] = out[slot, 2, 0] = xz
    out[slot, 1, 2] = out[slot, 2, 1] = yz
