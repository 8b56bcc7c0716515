"""A planner that follows the route with two PID controllers and ignores other objects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from real2sim_proto.plans import Control

from .follow_route import Comfort, Path, speed_limits
from .planner import Needs

if TYPE_CHECKING:
    from ..observation import Observation


@dataclass(frozen=True)
class Gains:
    """Gains of a PID controller: proportional, integral and derivative."""

    proportional: float
    integral: float = 0.0
    derivative: float = 0.0


class Pid:
    """``u = Kp e + Ki integral(e) + Kd de/dt``; no integration while ``u`` saturates."""

    def __init__(self, gains: Gains, *, low: float, high: float) -> None:
        """A controller with output limits ``low`` and ``high``."""
        self._gains, self._low, self._high = gains, low, high
        self._integral, self._before = 0.0, float("nan")

    def __call__(self, error: float, dt: float) -> float:
        """The output for an error ``dt`` seconds after the last one."""
        slope = 0.0 if math.isnan(self._before) or dt <= 0 else (error - self._before) / dt
        self._before = error
        gains, summed = self._gains, self._integral + error * dt
        wanted = gains.proportional * error + gains.integral * summed + gains.derivative * slope
        if self._low <= wanted <= self._high:
            self._integral = summed
        return min(max(wanted, self._low), self._high)


class PidFollowRoute:
    """A baseline: accelerates to a cruising speed, slows in bends, steers towards the route.

    The steering error is the lateral offset of the route at a preview distance, which combines
    offset and heading. The planner ignores everything else and collides with objects on the route.

    Examples:
        >>> planner = PidFollowRoute(speed=6.0)
        >>> with real2sim.connect() as client, client.session(scene="street") as session:
        ...     obs = session.reset(action="control")
        ...     planner.reset(obs)
        ...     obs = session.step(planner.plan(obs))
        >>> obs.step
        1
    """

    needs = Needs(action="control")

    def __init__(
        self,
        speed: float = 8.0,
        *,
        longitudinal: Gains = Gains(1.2, 0.1, 0.0),
        lateral: Gains = Gains(1.0, 0.05, 0.1),
        preview: float = 0.8,
        wheelbase: float = 2.8,
        comfort: Comfort | None = None,
    ) -> None:
        """Create a planner.

        Args:
            speed: cruising speed [m/s].
            longitudinal: gains from speed error [m/s] to acceleration [m/s^2].
            lateral: gains from curvature error [1/m], times ``wheelbase``, to steering angle [rad].
            preview: preview time [s]; the preview distance is at least 4 m.
            wheelbase: wheelbase of the vehicle [m].
            comfort: limits of acceleration; default: ``Comfort()``.
        """
        self.speed, self.comfort = speed, comfort or Comfort()
        self._gains = longitudinal, lateral
        self._preview, self._wheelbase = preview, wheelbase
        self._t_us: int | None = None
        self._forget()

    def reset(self, obs: Observation) -> None:
        """Reset the integrals."""
        self._forget()

    def plan(self, obs: Observation) -> Control:
        """Acceleration and wheel angle for the next step."""
        dt = 0.0 if self._t_us is None else (obs.t_us - self._t_us) * 1e-6
        self._t_us = obs.t_us
        path = Path.along(obs.route)
        limits = speed_limits(path, cruise=self.speed, comfort=self.comfort)
        acceleration = self._throttle(float(limits[0]) - obs.ego.speed, dt)
        steering = self._wheel(self._bend_to(path, obs.ego.speed) * self._wheelbase, dt)
        return Control(acceleration=acceleration, steering=steering)

    def _forget(self) -> None:
        longitudinal, lateral = self._gains
        comfort = self.comfort
        self._throttle = Pid(longitudinal, low=-2 * comfort.braking, high=comfort.acceleration)
        self._wheel = Pid(lateral, low=-0.6, high=0.6)
        self._t_us = None

    def _bend_to(self, path: Path, speed: float) -> float:
        """Curvature [1/m] of the arc from the vehicle to the route a preview distance ahead."""
        reach = max(4.0, self._preview * speed)
        far = np.linalg.norm(path.points, axis=1)
        x, y = path.points[int(np.abs(far - reach).argmin())]
        return float(2.0 * y / max(x * x + y * y, 1.0))
