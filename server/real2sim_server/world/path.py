"""The recorded way of the ego vehicle as a curve that everything else is measured along."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Trajectory
from ..scene.rotation import quaternion_to_matrix, quaternion_yaw

Float = NDArray[np.float64]

SPACING = 0.05
"""Logged poses nearer than this to the one before add nothing but noise [m]."""

STUB = 1.0
"""Length given to the path of a vehicle that never moved, along its heading [m]."""

NEAR_BEHIND, NEAR_AHEAD = 20.0, 60.0
"""Where along the path a vehicle is looked for first, from where it was last [m]."""

LOST = 10.0
"""Farther from the path than this, the whole of it is searched [m]."""


@dataclass(frozen=True)
class PathPoint:
    """Nearest point of the path to somewhere.

    Attributes:
        s: distance from the start of the path [m].
        offset: distance of the place from the path, positive on its left [m].
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
    """

    def __init__(self, ego: Trajectory) -> None:
        kept = _apart(ego.positions)
        self.positions = ego.positions[kept]
        self.yaws: Float = np.unwrap(quaternion_yaw(ego.quaternions[kept]))
        self.ups: Float = quaternion_to_matrix(ego.quaternions[kept])[:, :, 2]
        if len(kept) == 1:
            yaw = self.yaws[0]
            ahead = STUB * np.array([np.cos(yaw), np.sin(yaw), 0.0])
            self.positions = np.stack([self.positions[0], self.positions[0] + ahead])
            self.yaws, self.ups = np.repeat(self.yaws, 2), np.repeat(self.ups, 2, axis=0)
        # As complex numbers x + iy: (p - start) * turn has the share of the segment that lies
        # before p's foot as its real part, and p's distance to the left as its imaginary part,
        # both in lengths of the segment.
        plane = self.positions[:, 0] + 1j * self.positions[:, 1]
        steps = np.diff(plane)
        lengths = np.abs(steps)
        self._starts = plane[:-1]
        self._turns = steps.conj() / lengths**2
        self._squares = lengths**2
        self.s: Float = np.concatenate([[0.0], np.cumsum(lengths)])

    @property
    def length(self) -> float:
        """Distance from start to end [m]."""
        return float(self.s[-1])

    def nearest(self, x: float, y: float, *, near_s: float | None = None) -> PathPoint:
        """The nearest point of the path to (x, y).

        Args:
            x, y: world [m].
            near_s: where the vehicle was last; a path that crosses itself is not jumped over
                while the vehicle stays within 10 m of the part around it.
        """
        if near_s is not None:
            first, last = np.searchsorted(self.s, [near_s - NEAR_BEHIND, near_s + NEAR_AHEAD])
            first = max(int(first) - 1, 0)
            last = min(max(int(last), first + 1), len(self._starts))
            found = self._nearest(x, y, first, last)
            if abs(found.offset) <= LOST:
                return found
        return self._nearest(x, y, 0, len(self._starts))

    def _nearest(self, x: float, y: float, first: int, last: int) -> PathPoint:
        local = (complex(x, y) - self._starts[first:last]) * self._turns[first:last]
        foot = np.minimum(np.maximum(local.real, 0.0), 1.0)
        beyond = local.real - foot
        squares = (beyond * beyond + local.imag * local.imag) * self._squares[first:last]
        k = int(squares.argmin())
        offset = math.copysign(math.sqrt(squares[k]), local.imag[k])
        return self._point(first + k, float(foot[k]), offset)

    def _point(self, k: int, share: float, offset: float) -> PathPoint:
        rest = 1.0 - share
        x, y, z = (rest * self.positions[k] + share * self.positions[k + 1]).tolist()
        up = rest * self.ups[k] + share * self.ups[k + 1]
        a, b, c = (up / np.sqrt(up @ up)).tolist()
        return PathPoint(
            s=float(rest * self.s[k] + share * self.s[k + 1]),
            offset=offset,
            position=(x, y, z),
            yaw=float(rest * self.yaws[k] + share * self.yaws[k + 1]),
            up=(a, b, c),
        )


def _apart(positions: Float) -> list[int]:
    """Indices of poses at least SPACING from the last one kept, seen from above."""
    kept = [0]
    x, y = positions[0, :2].tolist()
    for i, (px, py) in enumerate(positions[:, :2].tolist()):
        if (px - x) ** 2 + (py - y) ** 2 >= SPACING**2:
            kept.append(i)
            x, y = px, py
    return kept
