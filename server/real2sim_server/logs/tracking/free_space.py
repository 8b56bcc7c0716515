"""Tells what has gone from what is merely out of sight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...geometry.rotation import Float

BEAM = 0.013
"""A beam tells about directions this near to its own [rad]."""

NEIGHBOURS = 4
SAME_RANGE = 0.4
"""A beam that ends this near to a point hit the thing that the point was on [m]."""

LEAST_RANGE = 1.0


@dataclass(frozen=True, eq=False)
class Witness:
    """Everything that one sweep saw: points [N, 3] in the world, seen from ``sensor`` [3]."""

    points: NDArray[np.float32]
    sensor: Float

    @cached_property
    def _beams(self) -> tuple[cKDTree, Float]:
        """Directions as a tree, and ranges; built when it is needed first."""
        rays = self.points - self.sensor
        ranges = np.linalg.norm(rays, axis=1)
        seen = ranges > LEAST_RANGE
        return cKDTree(rays[seen] / ranges[seen, None]), ranges[seen]

    def count(self, points: Float) -> tuple[int, int]:
        """How many of points [N, 3] in the world are seen to be free, and to be occupied.

        A beam that goes on behind a point says that it is free there, one that ends there that it
        is not, and one that ends before says nothing.
        """
        tree, ranges = self._beams
        rays = points - self.sensor
        away = np.linalg.norm(rays, axis=1)
        near = away > LEAST_RANGE
        if not near.any() or len(ranges) < NEIGHBOURS:
            return 0, 0
        rays, away = rays[near] / away[near, None], away[near]
        apart, index = tree.query(rays, k=NEIGHBOURS, distance_upper_bound=BEAM)
        known = np.isfinite(apart)
        found = np.where(known, ranges[np.minimum(index, len(ranges) - 1)], np.nan)
        beyond = found - away[:, None]
        occupied = (np.abs(beyond) < SAME_RANGE).any(axis=1)
        # NaN compares false: what no beam tells about is neither.
        passed = (beyond > SAME_RANGE).sum(axis=1)
        free = ~occupied & (passed > 0) & (passed == known.sum(axis=1))
        return int(free.sum()), int(occupied.sum())
