"""Objects that another client drives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from real2sim_proto.episode import ExternalDriver

from ...edit import ObjectState
from .driver import AgentPose, Surroundings, level_quaternion
from .replay import recorded_pose


@dataclass(frozen=True, eq=False)
class External:
    """Follows the newest plan it was given, exactly; then goes straight on as it moved last.

    Attributes:
        subject: the object.
        pose, present: see :class:`~.driver.AgentDriver`.
        times_us: [N] of the plan; empty before the first one [us].
        poses: [N] x, y [m], yaw [rad], world.
    """

    subject: ObjectState
    pose: AgentPose
    times_us: tuple[int, ...] = ()
    poses: tuple[tuple[float, float, float], ...] = ()
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, _spec: ExternalDriver, surroundings: Surroundings
    ) -> External:
        """From how the object moves now."""
        return cls(subject, recorded_pose(subject, surroundings.t_us))

    def with_plan(
        self, t_us: int, times_us: Sequence[int], poses: Sequence[tuple[float, float, float]]
    ) -> External:
        """The driver with a new plan; it leads there from where the object is at ``t_us``."""
        x, y, _ = self.pose.position
        here = (x, y, self.pose.yaw)
        return replace(self, times_us=(t_us, *times_us), poses=(here, *poses))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        t_us, (x, y, z) = surroundings.t_us + surroundings.dt_us, self.pose.position
        if not self.times_us or t_us > self.times_us[-1]:
            vx, vy, _ = self.pose.velocity
            moved = (x + vx * surroundings.dt, y + vy * surroundings.dt, z)
            velocity = (vx, vy, 0.0)
            return replace(self, pose=self.pose._replace(position=moved, velocity=velocity))
        nx, ny, yaw = self._planned(t_us)
        velocity = ((nx - x) / surroundings.dt, (ny - y) / surroundings.dt, 0.0)
        pose = AgentPose((nx, ny, z), level_quaternion(yaw), yaw, velocity)
        return replace(self, pose=pose)

    def _planned(self, t_us: int) -> tuple[float, float, float]:
        k = min(int(np.searchsorted(self.times_us, t_us)), len(self.times_us) - 1)
        a, b = self.poses[k - 1], self.poses[k]
        fraction = (t_us - self.times_us[k - 1]) / (self.times_us[k] - self.times_us[k - 1])
        turn = math.remainder(b[2] - a[2], math.tau)
        return (
            (1 - fraction) * a[0] + fraction * b[0],
            (1 - fraction) * a[1] + fraction * b[1],
            a[2] + fraction * turn,
        )
