"""Walls above the LiDAR's field of view.

A spinning LiDAR sees a few degrees upwards, a house is higher. Where a wall reaches the upper
limit of the scanner it is continued straight up; images then decide which part of that is real.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from .surfels import Surfels

CELL = 0.25
"""Edge of the columns into which walls are divided [m]."""
REACH, HEIGHT = 45.0, 14.0
"""Walls up to this far from the drive are continued by this much [m]."""
MIN_POINTS, MIN_EXTENT = 6, 0.8
"""A column is a wall when it has so many points over such a height [m]."""
MAX_DEVIATION = 28.0
"""Views of a real wall differ less than this in brightness, standard deviation of 0 to 255."""


@dataclass(frozen=True, eq=False)
class ScanLimit:
    """The highest rays of the scanner.

    Attributes:
        path: [P, 3] float64, positions of the vehicle in the world [m].
        height: of the scanner over the vehicle's origin [m].
        slope: tangent of the elevation of its highest ray.
    """

    path: Float
    height: float
    slope: float


def continue_walls(structure: Surfels, limit: ScanLimit, *, max_count: int) -> Surfels:
    """Surfels on walls above what the scanner can see, candidates to be judged by their colours.

    Args:
        structure: what stands on the ground, world frame.
        limit: of the scanner.
        max_count: at most so many; they lie farther apart if need be.
    """
    columns = _wall_columns(structure, limit)
    step = CELL
    while len(columns.start) * int(HEIGHT / step) > max_count:
        step *= 1.25
        if step > 4 * CELL:
            columns = columns.every_other()
            step = CELL
    return _rise(columns, step)


@dataclass(frozen=True, eq=False)
class _Columns:
    """Wall columns: xy [C, 2], direction [C] of the normal [rad], start [C] height in the world."""

    xy: Float
    direction: Float
    start: Float

    def every_other(self) -> _Columns:
        return _Columns(self.xy[::2], self.direction[::2], self.start[::2])


def _wall_columns(structure: Surfels, limit: ScanLimit) -> _Columns:
    from scipy.spatial import cKDTree

    upright = np.abs(structure.normals[:, 2]) < 0.3
    points = structure.points[upright].astype(np.float64)
    normals = structure.normals[upright].astype(np.float64)
    if len(points) == 0:
        return _Columns(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    cells = np.floor(points[:, :2] / CELL).astype(np.int64)
    _, index, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    xy = np.stack([np.bincount(index, points[:, a]) for a in (0, 1)], axis=1) / counts[:, None]
    top, bottom = np.full(len(counts), -np.inf), np.full(len(counts), np.inf)
    np.maximum.at(top, index, points[:, 2])
    np.minimum.at(bottom, index, points[:, 2])
    # A normal and its opposite are the same wall, hence the doubled angle.
    angle = 2 * np.arctan2(normals[:, 1], normals[:, 0])
    cosine, sine = (np.bincount(index, f(angle)) / counts for f in (np.cos, np.sin))
    distance, nearest = cKDTree(limit.path[:, :2]).query(xy, workers=-1)
    seen_up_to = limit.path[nearest, 2] + limit.height + limit.slope * distance
    wall = (
        (counts >= MIN_POINTS)
        & (top - bottom > MIN_EXTENT)
        & (np.hypot(cosine, sine) > 0.7)
        & (top > seen_up_to - 0.1)
        & (distance < REACH)
    )
    return _Columns(xy[wall], np.arctan2(sine, cosine)[wall] / 2, seen_up_to[wall])


def _rise(columns: _Columns, step: float) -> Surfels:
    levels = (np.arange(int(HEIGHT / step)) + 0.5) * step
    count, rows = len(columns.start), len(levels)
    points = np.empty((count, rows, 3))
    points[..., :2] = columns.xy[:, None]
    points[..., 2] = columns.start[:, None] + levels
    c, s = np.cos(columns.direction), np.sin(columns.direction)
    zero, one = np.zeros(count), np.ones(count)
    along = np.stack([-s, c, zero], axis=1)
    up = np.stack([zero, zero, one], axis=1)
    normal = np.stack([c, s, zero], axis=1)
    axes = np.stack([along, up, normal], axis=2)
    scales = np.tile(np.array([0.6 * CELL, 0.6 * step, 0.03]), (count * rows, 1))
    return Surfels(
        points.reshape(-1, 3).astype(np.float32),
        np.repeat(axes, rows, axis=0).astype(np.float32),
        scales.astype(np.float32),
    )


def real_walls(
    colours: NDArray[np.float32], known: NDArray[np.bool_], deviation: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Which candidates [N] are walls: seen, alike from all views, and not coloured like a sky.

    Args:
        colours: [N, 3] float32 in [0, 1].
        known: [N] bool.
        deviation: [N] float32, standard deviation of brightness between views, 0 to 255.
    """
    red, blue = colours[:, 0], colours[:, 2]
    blown_out = colours.min(axis=1) > 0.9
    bluish = (blue > red + 0.02) & (blue > 0.45)
    return np.asarray(known & (deviation < MAX_DEVIATION) & ~blown_out & ~bluish)
