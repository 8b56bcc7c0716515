"""A planner that follows the route and the lead vehicle with the intelligent driver model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from real2sim_proto.plans import TrajectoryPlan

from .follow_route import (
    Array,
    Comfort,
    Obstacle,
    Path,
    Profile,
    delays_of_poses,
    obstacles_on,
    speed_limits,
)
from .planner import Needs

if TYPE_CHECKING:
    from ..observation import Observation

STEP = 0.05
"""Time step of the integration [s]."""


@dataclass(frozen=True)
class Follower:
    """Parameters of the model (Treiber, Hennecke, Helbing 2000), SI units.

    Attributes:
        acceleration: maximum acceleration, a.
        braking: comfortable deceleration, b.
        hardest: maximum deceleration.
        headway: time gap to the lead vehicle, T [s].
        gap: bumper-to-bumper distance at standstill, s0 [m].
        clearance: free space required on either side of the vehicle [m].
    """

    acceleration: float = 1.5
    braking: float = 2.0
    hardest: float = 8.0
    headway: float = 1.2
    gap: float = 2.5
    clearance: float = 0.3

    def answer(self, speed: float, desired: float, gap: float, closing: float) -> float:
        """Acceleration [m/s^2] at ``gap`` [m] behind a lead vehicle.

        ``a (1 - (v/v0)^4 - (s*/s)^2)`` with ``s* = s0 + v T + v dv / (2 sqrt(a b))``.
        """
        wanted = self.gap + max(
            speed * self.headway
            + speed * closing / (2.0 * math.sqrt(self.acceleration * self.braking)),
            0.0,
        )
        free = 1.0 - (speed / max(desired, 0.1)) ** 4
        found = self.acceleration * (free - (wanted / max(gap, 0.1)) ** 2)
        return max(found, -self.hardest)


class Idm:
    """A planner with ground-truth objects: follows the route behind the lead vehicle.

    It assumes that others keep their speed along the route for the length of the plan.

    Examples:
        >>> planner = Idm(speed=6.0, follower=Follower(headway=1.5))
        >>> with real2sim.connect() as client, client.session(scene="street") as session:
        ...     obs = session.reset(privileged=True)
        ...     planner.reset(obs)
        ...     obs = session.step(planner.plan(obs))
        >>> obs.step
        1
    """

    needs = Needs(privileged=True)

    def __init__(
        self,
        speed: float = 8.0,
        *,
        horizon: float = 3.0,
        spacing: float = 0.25,
        follower: Follower | None = None,
        comfort: Comfort | None = None,
    ) -> None:
        """Create a planner.

        Args:
            speed: desired speed, v0 [m/s].
            horizon: length of a plan [s].
            spacing: time between its poses [s].
            follower: parameters of the model; default: ``Follower()``.
            comfort: limits in bends and on the return to the route; default: ``Comfort()``.

        Raises:
            ValueError: see :func:`~.follow_route.delays_of_poses`.
        """
        self._delays = delays_of_poses(speed=speed, horizon=horizon, spacing=spacing)
        self.speed = speed
        self.follower, self.comfort = follower or Follower(), comfort or Comfort()

    def reset(self, obs: Observation) -> None:
        """Nothing is remembered between plans."""

    def plan(self, obs: Observation) -> TrajectoryPlan:
        """Poses over the next seconds in the vehicle frame of ``obs``."""
        path = Path.along(obs.route)
        limits = speed_limits(path, cruise=self.speed, comfort=self.comfort)
        found = obstacles_on(path, obs.ego, obs.agents, clearance=self.follower.clearance)
        travelled = self._drive(path.arc, limits, found, speed=max(obs.ego.speed, 0.0))
        return TrajectoryPlan(
            times_us=[obs.t_us + round(delay * 1e6) for delay in self._delays],
            poses=[tuple(pose) for pose in path.poses(travelled, self.comfort.recovery).tolist()],
        )

    def _drive(self, arc: Array, limits: Array, found: list[Obstacle], *, speed: float) -> Array:
        """[K] float64 distance travelled after each delay [m]."""
        leaders = [(one.arc, max(one.speed, 0.0)) for one in found]
        profile, position, now = Profile(arc, limits), 0.0, 0.0
        travelled: list[float] = []
        for delay in self._delays.tolist():
            while now < delay - 1e-9:
                rate = self._rate(speed, profile.at(position), position, now, leaders)
                following = max(speed + rate * STEP, 0.0)
                position += 0.5 * (speed + following) * STEP
                speed, now = following, now + STEP
            travelled.append(position)
        return np.array(travelled)

    def _rate(
        self,
        speed: float,
        desired: float,
        position: float,
        now: float,
        leaders: list[tuple[float, float]],
    ) -> float:
        """The lowest acceleration over all leaders, each with its start position and speed."""
        answer = self.follower.answer
        rate = answer(speed, desired, math.inf, 0.0)
        for place, ahead in leaders:
            gap = place + ahead * now - position
            rate = min(rate, answer(speed, desired, gap, speed - ahead))
        return rate
