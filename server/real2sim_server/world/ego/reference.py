"""A planned trajectory that a vehicle is to follow."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.episode import EgoSpec

from ..._records import made_quickly
from ..driving import NO_POSE, curve_at, placed_poses, plan_curve, vehicle_parameters
from ..path import Float, LoopTransform
from .motion import ControlLaw, Motion

Pose = tuple[float, float, float]
"""x, y [m], yaw [rad] in the world."""


FEW, CLEARLY = 40, 1e-6
"""Poses up to so many are looked at one by one; a way [m] that no rounding turns round."""


LONGEST_GAP_US = 1_000_000
"""A plan of a single pose goes on from the one before where their poses are this near in time."""


@made_quickly
@dataclass(frozen=True, eq=False)
class PlannedTrajectory:
    """Where a planner wants to be when.

    Attributes:
        times_us: [N] int64, increasing [us].
        poses: [N, 3] float64, x, y [m], yaw [rad], world.
        is_clear: whether it is known already to lead forwards.
    """

    times_us: NDArray[np.int64]
    poses: Float
    is_clear: bool = False

    @staticmethod
    def of(
        times_us: Sequence[int], poses: Sequence[Pose], frame: Pose | None = None
    ) -> PlannedTrajectory:
        """The trajectory through poses of a frame, given by its pose in the world; None: world."""
        numbers, is_clear = np.array(poses, np.float64), False
        if frame is not None:
            numbers, is_clear = placed_poses(numbers, frame, CLEARLY)
        return PlannedTrajectory(np.array(times_us, np.int64), numbers, is_clear)

    @cached_property
    def leads_forwards(self) -> bool:
        """Whether no pose lies behind the one before, as both head."""
        if len(self.poses) < 2:
            return False
        return (
            self.is_clear or _leads_ahead(self.poses) or float(ways_along(self.poses).min()) >= 0.0
        )

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


class SinglePose(NamedTuple):
    """The only pose of a plan, in the world; the next plan of one pose goes on from it.

    Attributes:
        at_us: when the vehicle is to be there [us].
        x, y: [m].
        yaw: [rad].
    """

    at_us: int
    x: float
    y: float
    yaw: float

    @staticmethod
    def of(trajectory: PlannedTrajectory) -> SinglePose | None:
        """That of a plan, if it has one only."""
        if len(trajectory.poses) != 1:
            return None
        return SinglePose(int(trajectory.times_us[0]), *trajectory.poses[0].tolist())

    def before(self, start_us: int, at_us: int) -> tuple[float, float, float, float]:
        """As :func:`.driving.plan_curve` takes it for a plan that begins at ``start_us`` and whose
        pose is for ``at_us``; none where it is too old to say how fast that plan goes."""
        if not 0 < at_us - self.at_us <= LONGEST_GAP_US:
            return NO_POSE
        return (self.at_us - start_us) * 1e-6, self.x, self.y, self.yaw

    def speed_to(self, at_us: int, pose: Float) -> float | None:
        """Mean speed along the headings [m/s] to the pose [3] of the next plan; None where that is
        not one to go on to."""
        if not 0 < at_us - self.at_us <= LONGEST_GAP_US:
            return None
        way = ways_along(np.array([self[1:], pose]))
        return way.item() / ((at_us - self.at_us) * 1e-6)

    def put_back(self, seam: LoopTransform) -> SinglePose:
        """For a vehicle that was put back over the seam."""
        return SinglePose(self.at_us, *seam.poses(np.array([self[1:]]))[0].tolist())


class ReferenceTrajectory:
    """A planned trajectory as a smooth curve over time, see :mod:`.driving.curve`."""

    def __init__(
        self,
        motion: Motion,
        *,
        start_us: int,
        trajectory: PlannedTrajectory,
        spec: EgoSpec,
        before: SinglePose | None = None,
    ) -> None:
        """The curve of a vehicle that is in ``motion`` at ``start_us``.

        Args:
            motion: of the vehicle.
            start_us: now [us].
            trajectory: after ``start_us``.
            spec: of the vehicle.
            before: what a trajectory of a single pose goes on from.
        """
        goes_on = NO_POSE
        if before is not None and len(trajectory.poses) == 1:
            goes_on = before.before(start_us, int(trajectory.times_us[0]))
        self._curve = plan_curve(
            motion.numbers,
            start_us,
            (trajectory.times_us, trajectory.poses, goes_on),
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

    def put_back(self, seam: LoopTransform) -> ReferenceTrajectory:
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
