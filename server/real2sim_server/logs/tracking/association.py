"""Associates clusters from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from ...geometry.rotation import Float
from .clusters import LidarCluster
from .motion import KalmanState

DEVIATION = 0.5
"""Of a cluster's centre from frame to frame [m]: its visible part changes."""

MAHALANOBIS_GATE = 3.5
"""Farthest match, as a Mahalanobis distance."""

DISTANCE_GATE = 3.0
"""Farthest match [m]."""

GATED_COST = 1e6


@dataclass(eq=False)
class Track:
    """Clusters of one object, by frame."""

    state: KalmanState
    clusters: dict[int, LidarCluster] = field(default_factory=dict)

    @property
    def first(self) -> int:
        """First frame."""
        return min(self.clusters)

    @property
    def last(self) -> int:
        """Last frame."""
        return max(self.clusters)


def associate(
    scans: Sequence[Sequence[LidarCluster]], times: Float, *, max_missed: int
) -> list[Track]:
    """Tracks through all frames; one ends after ``max_missed`` frames without a cluster."""
    alive: list[Track] = []
    ended: list[Track] = []
    for frame, scan in enumerate(scans):
        if frame:
            for track in alive:
                track.state = track.state.predict(times[frame] - times[frame - 1])
        unassigned = _match(alive, scan, frame)
        ended += [t for t in alive if frame - t.last > max_missed]
        alive = [t for t in alive if frame - t.last <= max_missed]
        for index in unassigned:
            cluster = scan[index]
            state = KalmanState.first(cluster.centre, DEVIATION)
            alive.append(Track(state, {frame: cluster}))
    return ended + alive


def _match(tracks: Sequence[Track], clusters: Sequence[LidarCluster], frame: int) -> list[int]:
    """Assign clusters to tracks (Hungarian method); returns the indices left unassigned."""
    if not tracks or not clusters:
        return list(range(len(clusters)))
    centres = np.array([c.centre for c in clusters])
    costs = np.full((len(tracks), len(clusters)), GATED_COST)
    for row, track in enumerate(tracks):
        apart = np.linalg.norm(centres - track.state.mean[:2], axis=1)
        for column in np.flatnonzero(apart < DISTANCE_GATE).tolist():
            distance = track.state.distance(centres[column], DEVIATION)
            if distance < MAHALANOBIS_GATE:
                costs[row, column] = apart[column] + _extent_change(track, clusters[column])
    taken = set()
    for row, column in np.transpose(linear_sum_assignment(costs)).tolist():
        if costs[row, column] < GATED_COST:
            track, cluster = tracks[row], clusters[column]
            track.state = track.state.update(cluster.centre, DEVIATION)
            track.clusters[frame] = cluster
            taken.add(column)
    return [i for i in range(len(clusters)) if i not in taken]


def _extent_change(track: Track, cluster: LidarCluster) -> float:
    """How much the extent changes [m]: it distinguishes objects near each other."""
    latest = track.clusters[track.last]
    one = np.ptp(latest.points[:, :2], axis=0)
    two = np.ptp(cluster.points[:, :2], axis=0)
    return 0.3 * float(np.abs(one - two).sum())
