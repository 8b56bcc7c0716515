"""The recorded way of the ego vehicle as a curve that everything else is measured along."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import quaternion_to_matrix, quaternion_yaw
from ..scene import Trajectory
from .path_kernels import KNOT, nearest_point, point_at, sharpest_turn

Float = NDArray[np.float64]

SPACING = 0.05
"""Logged poses nearer than this to the one before add nothing but noise [m]."""

STUB = 1.0
"""Length given to the path of a vehicle that never moved, along its heading [m]."""


class PathPoint(NamedTuple):
    """Nearest point of the path to somewhere.

    Attributes:
        s: distance from the start of the path [m].
        offset: distance of the place from the path, positive on its left; from the straight line
            on where that is beyond an end of the path [m].
        position: the point itself, world [m].
        yaw: heading of the recorded vehicle there [rad].
        up: unit normal of the recorded vehicle's floor there, world.
    """

    s: float
    offset: float
    position: tuple[float, float, float]
    yaw: float
    up: tuple[float, float, float]


class LoggedPath:
    """Logged ego poses by distance travelled.

    Attributes:
        s: [P] float64, distance of each pose from the start, increasing [m].
        positions: [P, 3] float64, world [m].
        yaws: [P] float64, heading, continuous (not wrapped) [rad].
        ups: [P, 3] float64, unit floor normals.
        knots: [P, 11] float64, all of that as :mod:`.path_kernels` wants it.
    """

    def __init__(self, ego: Trajectory) -> None:
        kept = _apart(ego.positions)
        positions = ego.positions[kept]
        yaws: Float = np.unwrap(quaternion_yaw(ego.quaternions[kept]))
        ups: Float = quaternion_to_matrix(ego.quaternions[kept])[:, :, 2]
        if len(kept) == 1:
            ahead = STUB * np.array([np.cos(yaws[0]), np.sin(yaws[0]), 0.0])
            positions = np.stack([positions[0], positions[0] + ahead])
            yaws, ups = np.repeat(yaws, 2), np.repeat(ups, 2, axis=0)
        self._measure(positions, yaws, ups)

    def _measure(self, positions: Float, yaws: Float, ups: Float) -> None:
        self.positions, self.yaws, self.ups = positions, yaws, ups
        plane = self.positions[:, 0] + 1j * self.positions[:, 1]
        steps = np.diff(plane)
        lengths = np.abs(steps)
        turns = steps.conj() / lengths**2
        self.s: Float = np.concatenate([[0.0], np.cumsum(lengths)])
        self.knots: Float = np.zeros((len(self.s), KNOT))
        self.knots[:, 0], self.knots[:, 1:4] = self.s, self.positions
        self.knots[:, 4], self.knots[:, 5:8] = self.yaws, self.ups
        self.knots[:-1, 8], self.knots[:-1, 9] = turns.real, turns.imag
        self.knots[:-1, 10] = lengths**2

    @classmethod
    def through(cls, positions: Float, yaws: Float, ups: Float) -> Self:
        """The path through places [P, 3] [m], P >= 2, with continuous headings [P] [rad] and unit
        floor normals [P, 3]; places nearer than 5 cm to the one before are left out."""
        made = cls.__new__(cls)
        kept = _apart(positions)
        made._measure(positions[kept], yaws[kept], ups[kept])
        return made

    def beside(self, offset: float, *, reverse: bool = False) -> Self:
        """The path ``offset`` metres to the left of this one; ``reverse``: the other way round."""
        left = np.stack([-np.sin(self.yaws), np.cos(self.yaws), np.zeros(len(self.yaws))], axis=1)
        positions, yaws, ups = self.positions + offset * left, self.yaws, self.ups
        if reverse:
            positions, yaws, ups = positions[::-1], yaws[::-1] + np.pi, ups[::-1]
        return self.through(positions, yaws, ups)

    @property
    def length(self) -> float:
        """Distance from start to end [m]."""
        return float(self.s[-1])

    def at(self, s: float) -> tuple[float, float, float, float]:
        """The point x, y, z [m] and heading [rad] at distance ``s`` [m]; before the start and after
        the end straight on."""
        x, y, z, yaw = point_at(self.knots, float(s))
        return x, y, z, yaw

    def sharpest_turn(self, s: float, reach: float) -> float:
        """Largest curvature [1/m] over the ``reach`` metres from ``s`` on, in pieces of 4 m."""
        return float(sharpest_turn(self.knots, float(s), float(reach)))

    def nearest(self, x: float, y: float, *, near_s: float | None = None) -> PathPoint:
        """The nearest point of the path to (x, y).

        Args:
            x, y: world [m].
            near_s: where the vehicle was last; a path that crosses itself is not jumped over
                while the vehicle stays within 10 m of the part around it.
        """
        around = math.nan if near_s is None else near_s
        return PathPoint(*nearest_point(self.knots, float(x), float(y), around))


def _apart(positions: Float) -> list[int]:
    """Indices of poses at least SPACING from the last one kept, seen from above."""
    kept = [0]
    x, y = positions[0, :2].tolist()
    for i, (px, py) in enumerate(positions[:, :2].tolist()):
        if (px - x) ** 2 + (py - y) ** 2 >= SPACING**2:
            kept.append(i)
            x, y = px, py
    return kept
