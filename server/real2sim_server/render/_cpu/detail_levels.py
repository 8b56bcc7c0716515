"""Levels of detail of a cloud: merged Gaussians for small images, built once and cached.

Space is divided into cells along a Z curve, so cells of every size are contiguous ranges of one
order. Each block of cells selects its level independently. Level 0 is the original cloud, without a
copy. A Gaussian larger than the cells of a level is not merged on that level.

The Gaussians of a cell merge into one with the same moments. Each has the weight ``tau area``,
where tau = -ln(1 - opacity) is its optical depth and ``area`` its cross section averaged over all
directions. The merged Gaussian has the weighted mean centre and colour, and the covariance about
that centre. Its optical depth is the sum of the weights divided by its own area.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray
from torch import Tensor

from ..._numba import PARALLEL_LOOPS
from ...scene import GaussianCloud, TimeColour
from .drawing import NO_COEFFICIENTS, CloudArrays, array_of, arrays_of
from .lanes import inlined, kernel

OPACITY_MIN = 1.0 / 255.0
OPACITY_MAX = 0.999
OPAQUE = 2.0
"""Largest opacity of a merged Gaussian."""
EDGE = 0.5 / math.log(2.0)
"""Opacity per optical depth for which transmittance is 0.5 at the same distance from the centre."""
MOMENTS = 11
"""Sums over a cell: weight, centre, upper half of the covariance, count."""


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
    """Count the Gaussians of each block at a level.

    Args:
        codes: [N] int64, ascending positions along a Z curve.
        order: [N] int64, index of the Gaussian at each position.
        sizes: [N] float32, largest standard deviations [m].
        opacities: [N] float32.
        block_starts: [B + 1] int64, starts of the blocks in ``codes``.
        shift: bits of a code within a cell of the level.
        largest: standard deviation above which a Gaussian is not merged [m].
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
    """Write the Gaussians of a level. Further arguments as for count_merged.

    Args:
        firsts: [B] int64, first output row of each block.
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
    """Product of the two larger standard deviations [m^2]: exact if flat, else approximate."""
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
    """Write the Gaussian with the moments of a cell."""
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
    """Opacity of a merged Gaussian from the optical depth at its centre.

    Several opaque Gaussians next to each other have a plateau and an edge. An opacity above 1,
    which blending clips, reproduces both: the point of half transmittance is the same.
    """
    opacity = min(-math.expm1(-depth), OPACITY_MAX)
    if several:
        return min(max(opacity, depth * EDGE), OPAQUE)
    return opacity


@inlined()
def copy_one(
    i, slot, means, covars, opacities, features, out_means, out_covars, out_opacities, out_features
):
    """Copy Gaussian ``i``."""
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


# Levels of a cloud

LEVELS = 4
"""Number of merged levels; each has cells twice as large as the previous one."""
BLOCK_SHIFT = LEVELS - 1
"""A block is a cell of the last level, where a single merged Gaussian represents it."""
BITS = 21
"""Bits of a position along the Z curve, per axis."""
BANDS = 4
"""Spherical harmonics coefficients of merged Gaussians: up to degree 1."""
FINEST_CELL = 2.0
"""Side of the cells of level 1, relative to the median of the largest standard deviations."""

Longs = NDArray[np.int64]
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """A cloud with its levels of detail.

    Attributes:
        cloud: level 0, the cloud itself.
        coefficients: [N, F, 3] of its TimeColour; F is 0 without one.
        order: [N] int64, Gaussians of level 0 by block.
        starts: [1 + LEVELS, B + 1] int64, starts of the blocks: row 0 in ``order``, the others in
            the merged arrays.
        low, high: [B, 3] float64, boxes around the centres of a block [m].
        sigmas: [B] float64, largest standard deviation in a block [m].
        cell: side of the cells of level 1 [m]; 0 if all Gaussians are merged ones of level 1.
        means, covars, opacities, sh, merged_coefficients: concatenated merged levels.
    """

    cloud: CloudArrays
    coefficients: Floats
    order: Longs
    starts: Longs
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    sigmas: NDArray[np.float64]
    cell: float
    means: Floats
    covars: Floats
    opacities: Floats
    sh: Floats
    merged_coefficients: Floats

    @property
    def nbytes(self) -> int:
        """Memory in addition to that of the cloud [bytes]."""
        held = (getattr(self, field.name) for field in fields(self)[2:])
        return sum(v.nbytes for v in held if isinstance(v, np.ndarray))


_making = threading.Lock()
"""Serialises merging. Lookups of existing levels do not wait for it."""
_keeping = threading.Lock()
_plain: weakref.WeakKeyDictionary[GaussianCloud, Hierarchy] = weakref.WeakKeyDictionary()
_coloured: weakref.WeakKeyDictionary[TimeColour, tuple[weakref.ref[GaussianCloud], Hierarchy]] = (
    weakref.WeakKeyDictionary()
)


def hierarchy_of(cloud: GaussianCloud, colour: TimeColour | None = None) -> Hierarchy:
    """Levels of a cloud, built on the first call: about a second per million Gaussians."""
    known = known_hierarchy(cloud, colour)
    if known is not None:
        return known
    with _making:
        known = known_hierarchy(cloud, colour)
        if known is not None:
            return known
        made = make_hierarchy(cloud, colour)
        with _keeping:
            if colour is None:
                _plain[cloud] = made
            else:
                _coloured[colour] = weakref.ref(cloud), made
        return made


def known_hierarchy(cloud: GaussianCloud, colour: TimeColour | None = None) -> Hierarchy | None:
    """Levels of a cloud if they exist, else None."""
    with _keeping:
        if colour is None:
            return _plain.get(cloud)
        held = _coloured.get(colour)
        return held[1] if held is not None and held[0]() is cloud else None


def held_bytes() -> int:
    """Memory of the levels of all live clouds [bytes]."""
    with _keeping:
        held = [*_plain.values(), *(hierarchy for _, hierarchy in _coloured.values())]
    return sum(hierarchy.nbytes for hierarchy in held)


def deformed_hierarchy(
    cloud: GaussianCloud, covars: Tensor, colour: TimeColour | None
) -> Hierarchy:
    """Wrap a cloud with ``covars`` [N, 3, 3] as a single merged level, without merging."""
    arrays, matrices = arrays_of(cloud), array_of(covars)
    coefficients = NO_COEFFICIENTS if colour is None else array_of(colour.coefficients)
    starts = np.zeros((1 + LEVELS, 2), np.int64)
    starts[1:, 1] = len(arrays.means)
    largest = np.trace(matrices, axis1=1, axis2=2).max(initial=0.0)
    return Hierarchy(
        cloud=arrays,
        coefficients=coefficients,
        order=np.zeros(0, np.int64),
        starts=starts,
        low=arrays.means.min(0, keepdims=True).astype(np.float64),
        high=arrays.means.max(0, keepdims=True).astype(np.float64),
        sigmas=np.array([np.sqrt(largest)], np.float64),
        cell=0.0,
        means=arrays.means,
        covars=matrices,
        opacities=arrays.opacities,
        sh=arrays.sh,
        merged_coefficients=coefficients,
    )


def make_hierarchy(cloud: GaussianCloud, colour: TimeColour | None) -> Hierarchy:
    """Merge the Gaussians of a cloud, level by level."""
    arrays = arrays_of(cloud)
    coefficients = NO_COEFFICIENTS if colour is None else array_of(colour.coefficients)
    sizes = arrays.scales.max(1, initial=0.0)
    cell = _finest_cell(sizes)
    codes = _codes(arrays.means, cell)
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    blocks, first = np.unique(codes >> 3 * BLOCK_SHIFT, return_index=True)
    block_starts = np.append(first, len(codes)).astype(np.int64)
    starts = np.empty((1 + LEVELS, len(blocks) + 1), np.int64)
    starts[0] = block_starts

    covars = np.empty((len(codes), 6))
    upper_half(arrays.quats, arrays.scales, covars)
    bands = arrays.sh[:, :BANDS]
    features = np.concatenate(
        [bands.reshape(len(codes), -1), coefficients.reshape(len(codes), -1)], axis=1
    )
    merged, written = [], 0
    for level in range(LEVELS):
        counts = np.empty(len(blocks), np.int64)
        side = cell * 2.0**level
        places = (codes, order, sizes)
        count_merged(*places, arrays.opacities, block_starts, 3 * level, side, counts)
        ends = np.cumsum(counts)
        total = int(ends[-1]) if len(ends) else 0
        parts = (
            np.empty((total, 3), np.float32),
            np.empty((total, 3, 3), np.float32),
            np.empty(total, np.float32),
            np.empty((total, features.shape[1]), np.float32),
        )
        originals = (arrays.means, covars, arrays.opacities, features)
        merge_level(*places, block_starts, 3 * level, side, ends - counts, *originals, *parts)
        starts[1 + level, :-1] = written + ends - counts
        written += total
        starts[1 + level, -1] = written
        merged.append(parts)
    means, merged_covars, opacities, rows = (
        np.concatenate(part) for part in zip(*merged, strict=True)
    )
    colours = bands.shape[1] * 3
    low, high, sigmas = _block_bounds(arrays.means[order], sizes[order], block_starts)
    return Hierarchy(
        cloud=arrays,
        coefficients=coefficients,
        order=order,
        starts=starts,
        low=low,
        high=high,
        sigmas=sigmas,
        cell=cell,
        means=means,
        covars=merged_covars,
        opacities=opacities,
        sh=np.ascontiguousarray(rows[:, :colours]).reshape(-1, bands.shape[1], 3),
        merged_coefficients=np.ascontiguousarray(rows[:, colours:]).reshape(len(means), -1, 3),
    )


def _finest_cell(sizes: Floats) -> float:
    """Side of the cells of level 1, a power of two [m]."""
    typical = float(np.median(sizes)) if len(sizes) else 1.0
    return float(2.0 ** np.round(np.log2(max(typical * FINEST_CELL, 1e-6))))


def _codes(means: Floats, cell: float) -> Longs:
    """Positions [N] of the finest cells along a Z curve; outliers go to the outermost cells."""
    cells = np.floor(means.astype(np.float64) / cell) + 2 ** (BITS - 1)
    held = np.clip(cells, 0, 2**BITS - 1).astype(np.int64)
    return spread(held[:, 0]) | spread(held[:, 1]) << 1 | spread(held[:, 2]) << 2


def spread(values: Longs) -> Longs:
    """Insert two zero bits between neighbouring bits of the lowest 21."""
    masks = (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    )
    for shift, mask in masks:
        values = (values | values << shift) & mask
    return values


def _block_bounds(
    means: Floats, sizes: Floats, starts: Longs
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Boxes around the centres of blocks, and their largest sizes.

    ``means`` and ``sizes`` are sorted by block.
    """
    if len(starts) == 1:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    low = np.minimum.reduceat(means, starts[:-1], axis=0).astype(np.float64)
    high = np.maximum.reduceat(means, starts[:-1], axis=0).astype(np.float64)
    return low, high, np.maximum.reduceat(sizes, starts[:-1]).astype(np.float64)


# Arrays of many clouds for one kernel: a table of addresses. Numba would compile a kernel for each
# number of arrays, and concatenating clouds costs more than a small image.

FIELDS = (
    *("means", "quats", "scales", "opacities", "sh", "coefficients", "order", "starts"),
    *("low", "high", "sigmas"),
    *("merged_means", "merged_covars", "merged_opacities", "merged_sh", "merged_coefficients"),
)
"""Columns of the table that hold addresses."""
COUNT, MERGED, BLOCKS, BANDS_FIELD, MERGED_BANDS_FIELD, TONES, CELL = range(
    len(FIELDS), len(FIELDS) + 7
)
"""Columns that hold sizes; the last is the side of the finest merged cells [um]."""
COLUMNS = len(FIELDS) + 7


_rows: weakref.WeakKeyDictionary[Hierarchy, NDArray[np.int64]] = weakref.WeakKeyDictionary()


def table_of(hierarchies: Sequence[Hierarchy]) -> NDArray[np.int64]:
    """Table [H, COLUMNS] int64; valid while the hierarchies are alive."""
    table = np.empty((len(hierarchies), COLUMNS), np.int64)
    for row, hierarchy in zip(table, hierarchies, strict=True):
        known = _rows.get(hierarchy)
        if known is None:
            known = _rows[hierarchy] = _row(hierarchy)
        row[:] = known
    return table


def _row(held: Hierarchy) -> NDArray[np.int64]:
    arrays: tuple[NDArray[Any], ...] = (*held.cloud, held.coefficients, held.order, held.starts)
    arrays += (held.low, held.high, held.sigmas, held.means, held.covars, held.opacities)
    arrays += (held.sh, held.merged_coefficients)
    row = np.empty(COLUMNS, np.int64)
    row[: len(FIELDS)] = [array.ctypes.data for array in arrays]
    row[len(FIELDS) :] = (
        len(held.order),
        len(held.means),
        len(held.sigmas),
        held.cloud.sh.shape[1],
        held.sh.shape[1],
        held.coefficients.shape[1],
        round(held.cell * 1e6),
    )
    return row


@intrinsic
def pointer_to(typingctx: Any, address: Any) -> Any:
    """Cast an address to a pointer for ``carray``."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), generate
