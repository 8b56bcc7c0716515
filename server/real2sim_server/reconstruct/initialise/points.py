"""Measured points and their thinning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float

_BITS = 20
_HALF = 1 << (_BITS - 1)
MAX_LEVEL = 7


@dataclass(frozen=True, eq=False)
class PointSet:
    """LiDAR points in one frame.

    Attributes:
        points: [N, 3] float32 [m].
        intensity: [N] float32 in [0, 1].
        weight: [N] float32, how many measurements a point stands for.
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    weight: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> PointSet:
        """The points picked by a mask or by indices."""
        return PointSet(self.points[index], self.intensity[index], self.weight[index])

    @classmethod
    def measured(cls, points: Float, intensity: NDArray[np.float32]) -> PointSet:
        """Points that stand for one measurement each."""
        return cls(
            points.astype(np.float32),
            intensity.astype(np.float32),
            np.ones(len(points), dtype=np.float32),
        )

    @classmethod
    def join(cls, parts: list[PointSet]) -> PointSet:
        """All points of ``parts``, in order."""
        if not parts:
            return cls.measured(np.zeros((0, 3)), np.zeros(0, dtype=np.float32))
        return cls(
            np.concatenate([p.points for p in parts]),
            np.concatenate([p.intensity for p in parts]),
            np.concatenate([p.weight for p in parts]),
        )


def thin(cloud: PointSet, voxel: float, levels: NDArray[np.int64] | None = None) -> PointSet:
    """One point for each occupied voxel: the weighted mean of what lies inside.

    Args:
        cloud: any number of points.
        voxel: edge of a voxel of level 0 [m].
        levels: [N] in 0 to MAX_LEVEL, the edge doubles with each level; all 0 by default. Points
            of different levels are never merged.

    Returns:
        The means in the order of their voxels; total weight is kept.
    """
    if len(cloud) == 0:
        return cloud
    order, starts = _group(_voxel_keys(cloud.points, voxel, levels))
    weight = cloud.weight[order].astype(np.float64)
    total = np.add.reduceat(weight, starts)
    points = cloud.points[order].astype(np.float64) * weight[:, None]
    intensity = cloud.intensity[order].astype(np.float64) * weight
    return PointSet(
        (np.add.reduceat(points, starts, axis=0) / total[:, None]).astype(np.float32),
        (np.add.reduceat(intensity, starts) / total).astype(np.float32),
        total.astype(np.float32),
    )


def thin_to(
    cloud: PointSet, voxel: float, limit: int, levels: NDArray[np.int64] | None = None
) -> PointSet:
    """Like :func:`thin`, with voxels as much larger as it takes to stay within ``limit`` points."""
    thinned = thin(cloud, voxel, levels)
    while len(thinned) > limit:
        # Points lie on surfaces, so their number falls with the square of the edge.
        voxel *= max(1.05, (len(thinned) / limit) ** 0.5)
        thinned = thin(cloud, voxel, levels)
    return thinned


def _voxel_keys(
    points: NDArray[np.float32], voxel: float, levels: NDArray[np.int64] | None
) -> NDArray[np.int64]:
    edge = voxel if levels is None else (voxel * np.exp2(levels))[:, None]
    cells = np.floor(points.astype(np.float64) / edge).astype(np.int64)
    cells = np.clip(cells + _HALF, 0, 2 * _HALF - 1)
    key = (cells[:, 0] << (2 * _BITS)) | (cells[:, 1] << _BITS) | cells[:, 2]
    return key if levels is None else key | (levels << (3 * _BITS))


def _group(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Stable order that brings equal keys together, and where each group starts."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    return order, starts


def path_distance(points: NDArray[np.float32], path: Float) -> NDArray[np.float32]:
    """Distance [N] [m] of points [N, 3] from the nearest of ``path`` [P, 3], to about a metre.

    All points of one metre cell get the same value, so that levels change between cells only.
    """
    from scipy.spatial import cKDTree

    cells, inverse = _unique_cells(points)
    distance, _ = cKDTree(path).query(cells + 0.5, workers=-1)
    return np.asarray(distance.astype(np.float32)[inverse])


def _unique_cells(points: NDArray[np.float32]) -> tuple[Float, NDArray[np.int64]]:
    keys = _voxel_keys(points, 1.0, None)
    unique, inverse = np.unique(keys, return_inverse=True)
    mask = 2 * _HALF - 1
    parts = [(unique >> (2 * _BITS)) & mask, (unique >> _BITS) & mask, unique & mask]
    return np.stack(parts, axis=1).astype(np.float64) - _HALF, inverse


def voxel_levels(distance: NDArray[np.float32], voxel: float, growth: float) -> NDArray[np.int64]:
    """Levels [N] for :func:`thin`: the voxel nearest below ``max(voxel, growth * distance)``."""
    ratio = np.maximum(distance * (growth / voxel), 1.0)
    return np.asarray(np.clip(np.floor(np.log2(ratio)), 0, MAX_LEVEL), dtype=np.int64)


def well_supported(points: NDArray[np.float32], reach: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which points [N] have three others within their ``reach`` [N] [m]; loners are noise."""
    from scipy.spatial import cKDTree

    if len(points) < 4:
        return np.zeros(len(points), dtype=np.bool_)
    third, _ = cKDTree(points).query(points, k=[4], workers=-1)
    return np.asarray(third[:, 0] < reach)
