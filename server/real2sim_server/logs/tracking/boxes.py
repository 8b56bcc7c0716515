"""Fits a box of one size to all clusters of a moving object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from .clusters import LidarCluster
from .motion import smooth

DEVIATION = 0.15
"""Of the middle of a fitted box [m]."""

MIN_HEADING_SPEED = 0.7
"""Below this speed [m/s] the direction of motion says nothing about the heading."""

EXTENT_PERCENTILE = 80.0
"""Percentile of extents that counts as the size: the largest may have a neighbour in it."""


TYPICAL_LENGTHS = ((1.85, 4.4), (2.5, 5.1), (np.inf, 6.5))
"""Of vehicles up to a height [m]: cars, vans, lorries [m]."""


@dataclass(frozen=True, eq=False)
class FittedBox:
    """A box over time.

    Attributes:
        frames: [T] int, first to last without gaps.
        centres: [T, 3] world [m].
        headings: [T] [rad].
        velocities: [T, 2] world [m/s].
        size: (length, width, height) [m].
        residual: of the measured middles, root mean square [m].
    """

    frames: NDArray[np.intp]
    centres: Float
    headings: Float
    velocities: Float
    size: tuple[float, float, float]
    residual: float

    @property
    def category(self) -> str:
        """By its size."""
        length, width, height = self.size
        if length > 6.5 or height > 2.7:
            return "truck"
        if length < 1.3 and width < 1.2:
            return "pedestrian"
        if width < 1.1 and length < 2.6:
            return "cyclist"
        return "van" if height > 1.85 else "car"


def fit_box(clusters: Mapping[int, LidarCluster], times: Float) -> FittedBox:
    """A box of the size observed over all frames, with a smooth path and headings along it.

    A scanner sees the near sides only (an L from above), so the box is anchored to those: along
    each of its axes the face towards the sensor is where the points begin, and the far face
    follows from the size. A car only seen from behind is given a car's typical length.

    Args:
        clusters: by frame, in the world.
        times: of all frames of the log [s].
    """
    frames = np.arange(min(clusters), max(clusters) + 1)
    rough = [clusters[f].centre if f in clusters else None for f in frames.tolist()]
    states = smooth(times[frames], rough, 3 * DEVIATION)
    size: tuple[float, float, float] = 0.0, 0.0, 0.0
    positions: list[Float | None] = []
    for _ in range(2):
        headings = _headings(states)
        faces = {
            f: _faces(clusters[f], headings[i], states[i, 2:])
            for i, f in enumerate(frames.tolist())
            if f in clusters
        }
        size = _size(clusters, faces)
        positions = [
            _anchor_box(faces[f], clusters[f], headings[i], size) if f in faces else None
            for i, f in enumerate(frames.tolist())
        ]
        states = smooth(times[frames], positions, DEVIATION)
    grounds = np.interp(frames, list(clusters), [c.ground for c in clusters.values()])
    centres = np.column_stack([states[:, :2], _running_mean(grounds) + size[2] / 2])
    apart = [
        np.sum((p - s[:2]) ** 2) for p, s in zip(positions, states, strict=True) if p is not None
    ]
    residual = float(np.sqrt(np.mean(apart)))
    return FittedBox(frames, centres, _headings(states), states[:, 2:], size, residual)


def _headings(states: Float) -> Float:
    """Direction of motion [T]; while standing, that of the nearest moment of motion."""
    velocity = states[:, 2:]
    fast = np.flatnonzero(np.linalg.norm(velocity, axis=1) > MIN_HEADING_SPEED)
    if not len(fast):
        displacement = states[-1, :2] - states[0, :2]
        return np.full(len(states), np.arctan2(displacement[1], displacement[0]))
    nearest = fast[np.abs(np.arange(len(states))[:, None] - fast).argmin(axis=1)]
    angles = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0])[nearest])
    return _running_mean(angles)


def _running_mean(values: Float, reach: int = 3) -> Float:
    """Running mean over up to 2 reach + 1 values."""
    padded = np.pad(values, reach, mode="edge")
    return np.convolve(padded, np.full(2 * reach + 1, 1 / (2 * reach + 1)), mode="valid")


def _faces(cluster: LidarCluster, heading: float, velocity: Float) -> Float:
    """Where the points begin and end [2, 2] (axis; low, high) along and across the heading.

    Points that were measured earlier or later than the frame are moved along.
    """
    flat = cluster.points[:, :2] - cluster.offset[:, None] * velocity
    local = flat @ _axes(heading).T
    return np.percentile(local, [0.5, 99.5], axis=0).T


def _axes(heading: float) -> Float:
    """Rows: forward, left."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, sin], [-sin, cos]])


def _size(
    clusters: Mapping[int, LidarCluster], faces: Mapping[int, Float]
) -> tuple[float, float, float]:
    extents = np.array([np.ptp(f, axis=1) for f in faces.values()])
    length, width = np.percentile(extents, EXTENT_PERCENTILE, axis=0)
    tops = [np.percentile(c.points[:, 2], 99) - c.ground for c in clusters.values()]
    height = float(np.percentile(tops, EXTENT_PERCENTILE))
    # A vehicle seen from one end or one side only is completed by typical sizes.
    if width > 1.2 and length < 3.6:
        length = next(typical for top, typical in TYPICAL_LENGTHS if height < top)
    elif length > 2.6 and width < 1.5:
        width = 1.8 if height < 2.5 else 2.4
    return float(max(length, 0.5)), float(max(width, 0.5)), max(height, 0.5)


def _anchor_box(
    faces: Float, cluster: LidarCluster, heading: float, size: tuple[float, float, float]
) -> Float:
    """Middle [2] of a box whose near faces are where the points begin."""
    axes = _axes(heading)
    sensor = axes @ cluster.sensor[:2]
    middle = np.empty(2)
    for axis in (0, 1):
        low, high = faces[axis]
        if sensor[axis] < low:
            middle[axis] = low + size[axis] / 2
        elif sensor[axis] > high:
            middle[axis] = high - size[axis] / 2
        else:
            middle[axis] = (low + high) / 2
    return np.asarray(middle @ axes)
