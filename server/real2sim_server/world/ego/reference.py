"""A planned trajectory that a vehicle is to follow."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.episode import EgoSpec

from ..driving import curve_at, plan_curve, vehicle_parameters, world_poses
from ..path import Float
from ..seam import Seam
from .motion import ControlLaw, Motion

Pose = tuple[float, float, float]
"""x, y [m], yaw [rad] in the world."""


FEW, CLEARLY = 40, 1e-6
"""Poses up to so many are looked at one by one; a way [m] that no rounding turns round."""


@dataclass(frozen=True, eq=False)
class PlannedTrajectory:
    """Where a planner wants to be when.

    Attributes:
        times_us: [N] int64, increasing [us].
        poses: [N, 3] float64, x, y [m], yaw [rad], world.
    """

    times_us: NDArray[np.int64]
    poses: Float

    @staticmethod
    def of(
        times_us: Sequence[int], poses: Sequence[Pose], frame: Pose | None = None
    ) -> PlannedTrajectory:
        """The trajectory through poses of a frame, given by its pose in the world; None: world."""
        numbers = np.array(poses, np.float64)
        if frame is not None:
            numbers = world_poses(numbers, frame)
        return PlannedTrajectory(np.array(times_us, np.int64), numbers)

    @cached_property
    def leads_forwards(self) -> bool:
        """Whether no pose lies behind the one before, as both head."""
        if len(self.poses) < 2:
            return False
        return _leads_ahead(self.poses) or float(ways_along(self.poses).min()) >= 0.0

    def after(self, t_us: int) -> PlannedTrajectory:
        """What of it is still to come: its end, at once, where all of it is over."""
        if t_us < self.times_us.item(0):
            return self
        over = int(np.searchsorted(self.times_us, t_us, side="right"))
        if over == len(self.times_us):
            return PlannedTrajectory(np.array([t_us + 1]), self.poses[-1:])
        return PlannedTrajectory(self.times_us[over:], self.poses[over:])


def _leads_ahead(poses: Float) -> bool:
    """Whether a plan of a few poses clearly goes along its headings everywhere, as nearly all do:
    without the arrays of :func:`ways_along`, which take twice as long."""
    if len(poses) > FEW:
        return False
    x, y, yaw = poses[0].tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    for px, py, pyaw in poses[1:].tolist():
        pcos, psin = math.cos(pyaw), math.sin(pyaw)
        if (px - x) * (cos + pcos) + (py - y) * (sin + psin) < CLEARLY:
            return False
        x, y, cos, sin = px, py, pcos, psin
    return True


def ways_along(poses: Float) -> Float:
    """[..., N - 1] way from each of poses [..., N, 3] to the next along their mean heading [m]."""
    x, y, yaw = poses[..., 0], poses[..., 1], poses[..., 2]
    cos, sin = np.cos(yaw), np.sin(yaw)
    dx, dy = x[..., 1:] - x[..., :-1], y[..., 1:] - y[..., :-1]
    ways: Float = (dx * (cos[..., 1:] + cos[..., :-1]) + dy * (sin[..., 1:] + sin[..., :-1])) / 2
    return ways


class ReferenceTrajectory:
    """A planned trajectory as a smooth curve over time, see :mod:`.driving.curve`."""

    def __init__(
        self,
        motion: Motion,
        *,
        start_us: int,
        trajectory: PlannedTrajectory,
        spec: EgoSpec,
    ) -> None:
        """The curve of a vehicle that is in ``motion`` at ``start_us``.

        Args:
            motion: of the vehicle.
            start_us: now [us].
            trajectory: after ``start_us``.
            spec: of the vehicle.
        """
        self._curve = plan_curve(
            motion.numbers,
            trajectory.times_us,
            start_us,
            trajectory.poses,
            tuple(vehicle_parameters(spec)),
        )

    @property
    def end(self) -> float:
        """Time of the last pose, from the start [s]."""
        return float(self._curve[0][-1, 0])

    @property
    def last_pose(self) -> Pose:
        """x, y [m], yaw [rad] in the world."""
        _, x, y, yaw, _, _ = self._curve[0][-1].tolist()
        return x, y, yaw

    def put_back(self, seam: Seam) -> ReferenceTrajectory:
        """The curve of a vehicle that was put back over the seam."""
        knots = self._curve[0].copy()
        knots[:, 1:4] = seam.poses(knots[:, 1:4])
        # The tangents turn, and have no place.
        vx, vy, cos, sin = knots[:, 4], knots[:, 5], math.cos(seam.turn), math.sin(seam.turn)
        knots[:, 4:6] = np.column_stack([cos * vx - sin * vy, sin * vx + cos * vy])
        moved = copy.copy(self)
        moved._curve = (knots, *self._curve[1:])
        return moved

    def control_law(self, kind: int) -> ControlLaw:
        """Follows the plan by PURSUIT, LQR or ILQR."""
        return ControlLaw(kind, *self._curve)

    def at(self, t: float) -> tuple[float, float, float, float, float]:
        """x, y [m], velocity x, y [m/s] and planned heading [rad] in the world, ``t`` >= 0 seconds
        after the start."""
        x, y, vx, vy, yaw = curve_at(self._curve, float(t))
        return x, y, vx, vy, yaw
