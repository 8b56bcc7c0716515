"""The levels of detail of a cloud, made once and kept with it.

Space is cut into cells along a Z curve, so that cells of all sizes are stretches of one order.
Blocks of cells choose their level each for itself; level 0 is the cloud, which is not copied. A
Gaussian larger than the cells of a level stays as it is there.
"""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from .....scene import GaussianCloud, TimeColour
from ..cull import CloudArrays, arrays_of
from ..inputs import NO_COEFFICIENTS, array_of
from .merge import count_merged, merge_level, upper_half

LEVELS = 4
"""Merged ones; each has cells twice as large as the one before."""
BLOCK_SHIFT = LEVELS - 1
"""A block is a cell of the last level: there, one Gaussian is left of it."""
BITS = 21
"""Of a place along the Z curve, by axis."""
BANDS = 4
"""Coefficients of the spherical harmonics that merged Gaussians keep: those up to degree 1."""
FINEST_CELL = 2.0
"""Cells of the first level, in the median size (largest standard deviation) of the Gaussians."""

Longs = NDArray[np.int64]
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """A cloud in levels of detail.

    Attributes:
        cloud: level 0, as it is.
        coefficients: [N, F, 3] of its TimeColour; F is 0 where there is none.
        order: [N] int64, Gaussians of level 0 by block.
        starts: [1 + LEVELS, B + 1] int64, where blocks begin: in ``order`` and in the
            arrays below.
        low, high: [B, 3] float64, boxes around the centres of a block [m].
        sigmas: [B] float64, largest standard deviation in a block [m].
        cell: side of the cells of level 1 [m]; 0 where there are merged Gaussians alone, all of
            them in level 1.
        means, covars, opacities, sh, merged_coefficients: merged levels, one after the other.
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
        """Memory beside that of the cloud itself [bytes]."""
        held = (getattr(self, field.name) for field in fields(self)[2:])
        return sum(v.nbytes for v in held if isinstance(v, np.ndarray))


_making = threading.Lock()
"""One at a time is merged; who asks for levels that are there does not wait for it."""
_keeping = threading.Lock()
_plain: weakref.WeakKeyDictionary[GaussianCloud, Hierarchy] = weakref.WeakKeyDictionary()
_coloured: weakref.WeakKeyDictionary[TimeColour, tuple[weakref.ref[GaussianCloud], Hierarchy]] = (
    weakref.WeakKeyDictionary()
)


def hierarchy_of(cloud: GaussianCloud, colour: TimeColour | None = None) -> Hierarchy:
    """The levels of a cloud; made at the first call: about a second for a million Gaussians."""
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
    """The levels of a cloud, if they are made already."""
    with _keeping:
        if colour is None:
            return _plain.get(cloud)
        held = _coloured.get(colour)
        return held[1] if held is not None and held[0]() is cloud else None


def held_bytes() -> int:
    """Memory of the levels of all clouds that are alive [bytes]."""
    with _keeping:
        held = [*_plain.values(), *(hierarchy for _, hierarchy in _coloured.values())]
    return sum(hierarchy.nbytes for hierarchy in held)


def deformed_hierarchy(
    cloud: GaussianCloud, covars: Tensor, colour: TimeColour | None
) -> Hierarchy:
    """A cloud with covariances of its own, as if it had been merged into itself."""
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
    """Places [N] of the finest cells along a Z curve; what is too far out shares the outermost."""
    cells = np.floor(means.astype(np.float64) / cell) + 2 ** (BITS - 1)
    held = np.clip(cells, 0, 2**BITS - 1).astype(np.int64)
    return spread(held[:, 0]) | spread(held[:, 1]) << 1 | spread(held[:, 2]) << 2


def spread(values: Longs) -> Longs:
    """Two zero bits between any two of the lowest 21 bits."""
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
    """Boxes around the centres of blocks, and their largest sizes; all are given by block."""
    if len(starts) == 1:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    low = np.minimum.reduceat(means, starts[:-1], axis=0).astype(np.float64)
    high = np.maximum.reduceat(means, starts[:-1], axis=0).astype(np.float64)
    return low, high, np.maximum.reduceat(sizes, starts[:-1]).astype(np.float64)
