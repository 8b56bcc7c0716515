"""Distinguishes free space from what is merely occluded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...geometry.rotation import Float

BEAM = 0.013
"""A beam observes directions this near to its own [rad]."""

NEIGHBOURS = 4
SAME_RANGE = 0.4
"""A beam that ends this near to a point hit the same surface [m]."""

MIN_RANGE = 1.0


@dataclass(frozen=True, eq=False)
class SweepRays:
    """Rays of one sweep: from ``sensor`` [3] to ``points`` [N, 3], world [m]."""

    points: NDArray[np.float32]
    sensor: Float

    @cached_property
    def _beams(self) -> tuple[cKDTree, Float]:
        """Directions as a tree, and ranges; built when it is needed first."""
        rays = self.points - self.sensor
        ranges = np.linalg.norm(rays, axis=1)
        seen = ranges > MIN_RANGE
        return cKDTree(rays[seen] / ranges[seen, None]), ranges[seen]

    def count(self, points: Float) -> tuple[int, int]:
        """How many of points [N, 3] in the world are observed free, and how many occupied.

        A beam that passes a point observes free space there, one that ends at the point observes
        it occupied, and one that ends before it observes nothing.
        """
        tree, ranges = self._beams
        rays = points - self.sensor
        distance = np.linalg.norm(rays, axis=1)
        near = distance > MIN_RANGE
        if not near.any() or len(ranges) < NEIGHBOURS:
            return 0, 0
        rays, distance = rays[near] / distance[near, None], distance[near]
        apart, index = tree.query(rays, k=NEIGHBOURS, distance_upper_bound=BEAM)
        known = np.isfinite(apart)
        found = np.where(known, ranges[np.minimum(index, len(ranges) - 1)], np.nan)
        beyond = found - distance[:, None]
        occupied = (np.abs(beyond) < SAME_RANGE).any(axis=1)
        # NaN compares false: what no beam observes is neither.
        passed = (beyond > SAME_RANGE).sum(axis=1)
        free = ~occupied & (passed > 0) & (passed == known.sum(axis=1))
        return int(free.sum()), int(occupied.sum())
