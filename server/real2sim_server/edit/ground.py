"""The ground as a recording knows it: under the wheels that drove, and under the boxes it saw."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..geometry.box import box_corners
from ..geometry.rotation import Float, quaternion_to_matrix
from ..geometry.transform import transform_from
from ..scene import Trajectory

SPACING = 1.0
"""Of the samples of a path [m]."""

REACH = 10.0
"""The plane under the ego is trusted this far to the side [m]; beyond, its rim's height holds."""

NEAR = 2.0
"""Standard deviation of the weight with which a sample tells the height beside it [m]."""

PRIOR = 0.05
"""Weight of the plane under the ego against that of samples."""

ODD = 1.0
"""Boxes whose bottoms are this far from the plane under the ego hang, or stand elsewhere [m]."""

MIN_UPRIGHT = 0.5
"""Normals that lean more than 60 degrees are no ground; it counts as level there."""

SAMPLES_OF_A_BOX = 40
AT_ONCE = 256


class Boxed(Protocol):
    """What tells where the ground was beside the ego's path."""

    @property
    def size(self) -> tuple[float, float, float]: ...  # noqa: D102
    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class RecordedGround:
    """Height of the ground, callable as ``GroundHeight``.

    The plane under the nearest pose of the ego, corrected by how far the bottoms of recorded boxes
    nearby are off that plane. Same recording, same bits.

    Attributes:
        path: [P, 3] float64, points the ego stood on, about 1 m apart [m].
        normals: [P, 3] float64, unit, of the ground there.
        spots: [B, 2] float64, where the bottoms of boxes were [m].
        offsets: [B] float64, their height above the plane under the ego [m].
    """

    path: Float
    normals: Float
    spots: Float
    offsets: Float

    @classmethod
    def of(cls, ego: Trajectory, things: Iterable[Boxed]) -> RecordedGround:
        """The ground below ``ego`` and the boxes of ``things``."""
        kept = _thinned(ego.positions)
        normals = quaternion_to_matrix(ego.quaternions[kept])[:, :, 2]
        normals = np.where(normals[:, 2:] > MIN_UPRIGHT, normals, [0.0, 0.0, 1.0])
        plane = cls(ego.positions[kept], normals, np.zeros((0, 2)), np.zeros(0))
        bottoms = np.concatenate([np.zeros((0, 3)), *(_bottoms(t) for t in things)])
        offsets = bottoms[:, 2] - plane(bottoms[:, :2])
        fit = np.abs(offsets) < ODD
        # The ego's own points hold their place against boxes beside the path.
        spots = np.concatenate([plane.path[:, :2], bottoms[fit, :2]])
        return cls(plane.path, normals, spots, np.append(np.zeros(len(kept)), offsets[fit]))

    def __call__(self, points: Float) -> Float:
        """Ground height [S] [m] below ``points`` [S, 2] [m] of the world."""
        parts = [self._heights(points[i : i + AT_ONCE]) for i in range(0, len(points), AT_ONCE)]
        return np.concatenate([np.zeros(0), *parts])

    def _heights(self, points: Float) -> Float:
        apart = points[:, None] - self.path[None, :, :2]
        distance = np.linalg.norm(apart, axis=2)
        nearest = distance.argmin(axis=1)
        rows = np.arange(len(points))
        aside, beyond = apart[rows, nearest], distance[rows, nearest]
        normal = self.normals[nearest]
        slope = -(normal[:, :2] * aside).sum(axis=1) / normal[:, 2]
        trusted = np.minimum(1.0, REACH / np.maximum(beyond, REACH))
        plane: Float = self.path[nearest, 2] + trusted * slope
        if not len(self.spots):
            return plane
        near = np.linalg.norm(points[:, None] - self.spots[None], axis=2) / NEAR
        weights = np.exp(-0.5 * near**2)
        return plane + (weights * self.offsets).sum(axis=1) / (weights.sum(axis=1) + PRIOR)


def bottoms_of(transforms: Float, size: tuple[float, float, float]) -> Float:
    """Centres [S, 3] [m] of the four lowest corners of boxes at ``transforms`` [S, 4, 4]."""
    corners = box_corners(transforms, size)
    lowest = np.argsort(corners[..., 2], axis=1, kind="stable")[:, :4]
    chosen: Float = np.take_along_axis(corners, lowest[..., None], axis=1)
    return chosen.mean(axis=1)


def _bottoms(thing: Boxed) -> Float:
    track = thing.trajectory
    kept = _thinned(track.positions)
    kept = kept[:: -(-len(kept) // SAMPLES_OF_A_BOX)]
    poses = transform_from(track.positions[kept], track.quaternions[kept])
    return bottoms_of(poses, thing.size)


def _thinned(positions: Float) -> np.ndarray:
    """Indices of positions about ``SPACING`` apart along the way, the first always among them."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    _, first = np.unique(np.floor(way / SPACING), return_index=True)
    return first
