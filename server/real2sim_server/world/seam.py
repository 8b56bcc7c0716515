"""The seam of a loop: where the ego was put back, as a rigid motion of the plane."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


class Seam(NamedTuple):
    """Takes places as they were before the ego was put back to where they are for it after.

    Attributes:
        x, y: shift after the turn [m].
        turn: about the origin of the world [rad].
    """

    x: float
    y: float
    turn: float

    @classmethod
    def between(cls, before: tuple[float, float, float], after: tuple[float, float, float]) -> Seam:
        """The one that takes the pose ``before``, x, y [m], yaw [rad], to the pose ``after``."""
        turn = after[2] - before[2]
        cos, sin = math.cos(turn), math.sin(turn)
        x = after[0] - cos * before[0] + sin * before[1]
        return cls(x, after[1] - sin * before[0] - cos * before[1], turn)

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where a place is [m]."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        return cos * x - sin * y + self.x, sin * x + cos * y + self.y

    def poses(self, poses: Float) -> Float:
        """Poses [N, 3] of x, y [m], yaw [rad]."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        x, y, yaw = poses.T
        return np.column_stack(
            [cos * x - sin * y + self.x, sin * x + cos * y + self.y, yaw + self.turn]
        )
