"""Follows clusters from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from ...geometry.rotation import Float
from .clusters import Cluster
from .motion import State

DEVIATION = 0.5
"""Of a cluster's middle from frame to frame [m]: its visible part changes."""

GATE = 3.5
"""Farthest match, as a Mahalanobis distance."""

STEP = 3.0
"""Farthest match [m]."""

REFUSED = 1e6


@dataclass(eq=False)
class Track:
    """Clusters that are one thing, by frame."""

    state: State
    clusters: dict[int, Cluster] = field(default_factory=dict)

    @property
    def first(self) -> int:
        """First frame."""
        return min(self.clusters)

    @property
    def last(self) -> int:
        """Last frame."""
        return max(self.clusters)


def follow(scans: Sequence[Sequence[Cluster]], times: Float, *, patience: int) -> list[Track]:
    """Trails through all frames; one ends after ``patience`` frames without a cluster."""
    alive: list[Track] = []
    ended: list[Track] = []
    for frame, scan in enumerate(scans):
        if frame:
            for trail in alive:
                trail.state = trail.state.predict(times[frame] - times[frame - 1])
        free = _match(alive, scan, frame)
        ended += [t for t in alive if frame - t.last > patience]
        alive = [t for t in alive if frame - t.last <= patience]
        for index in free:
            cluster = scan[index]
            state = State.first(cluster.centre, DEVIATION)
            alive.append(Track(state, {frame: cluster}))
    return ended + alive


def _match(trails: Sequence[Track], clusters: Sequence[Cluster], frame: int) -> list[int]:
    """Give trails their clusters; returns the clusters that nobody gets (Hungarian method)."""
    if not trails or not clusters:
        return list(range(len(clusters)))
    centres = np.array([c.centre for c in clusters])
    costs = np.full((len(trails), len(clusters)), REFUSED)
    for row, trail in enumerate(trails):
        apart = np.linalg.norm(centres - trail.state.mean[:2], axis=1)
        for column in np.flatnonzero(apart < STEP).tolist():
            distance = trail.state.distance(centres[column], DEVIATION)
            if distance < GATE:
                costs[row, column] = apart[column] + _change(trail, clusters[column])
    taken = set()
    for row, column in np.transpose(linear_sum_assignment(costs)).tolist():
        if costs[row, column] < REFUSED:
            trail, cluster = trails[row], clusters[column]
            trail.state = trail.state.update(cluster.centre, DEVIATION)
            trail.clusters[frame] = cluster
            taken.add(column)
    return [i for i in range(len(clusters)) if i not in taken]


def _change(trail: Track, cluster: Cluster) -> float:
    """How much the extent changes [m]: two things near each other are told apart by it."""
    latest = trail.clusters[trail.last]
    one = np.ptp(latest.points[:, :2], axis=0)
    two = np.ptp(cluster.points[:, :2], axis=0)
    return 0.3 * float(np.abs(one - two).sum())
