"""A planned trajectory that a vehicle is to follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from real2sim_proto.episode import EgoSpec

from .driving import curve_at, plan_curve, vehicle_of
from .ego import Driver, Motion

Pose = tuple[float, float, float]
"""x, y [m], yaw [rad] in the world."""


class Reference:
    """A plan as a smooth curve over time, see :mod:`.driving.curve`.

    Attributes:
        end: time of the last pose, from the start [s].
        last_pose: x, y [m], yaw [rad] in the world.
    """

    def __init__(
        self,
        motion: Motion,
        *,
        start_us: int,
        times_us: Sequence[int],
        poses: Sequence[Pose],
        spec: EgoSpec,
    ) -> None:
        """The plan of a vehicle that is in ``motion`` at ``start_us``.

        Args:
            motion: of the vehicle.
            start_us: now [us].
            times_us: N of them, increasing, after ``start_us`` [us].
            poses: N of them.
            spec: of the vehicle.
        """
        self._curve = plan_curve(
            motion.numbers,
            np.array(times_us, np.int64),
            start_us,
            np.array(poses, np.float64),
            tuple(vehicle_of(spec)),
        )
        self.end = (times_us[-1] - start_us) * 1e-6
        self.last_pose = poses[-1]

    def driver(self, kind: int) -> Driver:
        """Who follows the plan: PURSUIT, LQR or ILQR."""
        return Driver(kind, *self._curve)

    def at(self, t: float) -> tuple[float, float, float, float, float]:
        """x, y [m], velocity x, y [m/s] and planned heading [rad] in the world, ``t`` >= 0 seconds
        after the start."""
        x, y, vx, vy, yaw = curve_at(self._curve, float(t))
        return x, y, vx, vy, yaw
