"""Pure pursuit: aim at where the plan will be."""

from __future__ import annotations

import math
from dataclasses import dataclass

from real2sim_proto.episode import EgoSpec

from ..actuators import Command
from ..ego import Motion, drive
from ..reference import Reference
from ..vehicle import vehicle_of

LOOKAHEAD = 0.4
"""The controller aims at where the plan is this much later [s]."""

MIN_AIM = 3.0
"""Steering aims at least this far ahead; nearer aims would turn centimetres into angles [m]."""

AIM_TRIES = 8
MAX_LAG = 2.0
"""Distance behind or ahead of the plan beyond which the controller hurries no more [m]."""

GENTLE_BRAKING = 2.0
"""Deceleration after the plan's end [m/s^2]."""


@dataclass(frozen=True, eq=False)
class Pursuit:
    """Steering is pure pursuit (Coulter 1992, CMU-RI-TR-92-01): the arc that ends at the aim. The
    aim lies on the plan, so the arc carries the plan's curvature. Acceleration is what brings the
    vehicle to where the plan is after the look-ahead time T, from s = v T + a T^2 / 2; with its
    two gains 2 / T^2 and 2 / T the lag behind a moving plan decays with damping 0.7.

    Attributes:
        reference: what to follow.
        spec: of the vehicle.
    """

    reference: Reference
    spec: EgoSpec

    def advance(self, motion: Motion, since: float, dt_us: int) -> Motion:
        """The vehicle ``dt_us`` later."""
        return drive(motion, lambda m, t: self.command(m, since + t), self.spec, dt_us)

    def command(self, motion: Motion, t: float) -> Command:
        """What to do in ``motion``, ``t`` seconds after the plan's start."""
        if t >= self.reference.end:
            aim = _straight_on(motion, *self.reference.last_pose)
            return Command(-GENTLE_BRAKING, self._steering(motion, *aim))
        x, y, vx, vy = self.reference.at(t + LOOKAHEAD)
        acceleration = _acceleration(motion, (x - motion.x, y - motion.y), (vx, vy))
        if math.hypot(x - motion.x, y - motion.y) < MIN_AIM:
            x, y = self._farther_aim(motion, t + LOOKAHEAD)
        return Command(acceleration, self._steering(motion, x, y))

    def _steering(self, motion: Motion, x: float, y: float) -> float:
        """Road-wheel angle [rad] of the arc from the rear axle to (x, y)."""
        dx, dy = x - motion.x, y - motion.y
        left = math.cos(motion.yaw) * dy - math.sin(motion.yaw) * dx
        curvature = 2 * left / (dx * dx + dy * dy)
        rolling = math.atan(self.spec.wheelbase * curvature)
        if self.spec.dynamics == "kinematic_bicycle":
            return rolling
        return rolling + vehicle_of(self.spec).understeer * motion.speed**2 * curvature

    def _farther_aim(self, motion: Motion, t: float) -> tuple[float, float]:
        """The first place of the plan after ``t`` that is far enough.

        Where the plan stops before that, a place on the line straight on from where it stands.
        """
        for _ in range(AIM_TRIES):
            t = min(t + LOOKAHEAD, self.reference.end)
            x, y, _, _ = self.reference.at(t)
            if math.hypot(x - motion.x, y - motion.y) >= MIN_AIM:
                return x, y
        return _straight_on(motion, x, y, self.reference.heading(t))


def _straight_on(motion: Motion, x: float, y: float, yaw: float) -> tuple[float, float]:
    """A place to aim at, on the line from (x, y) along ``yaw``."""
    dx, dy = math.cos(yaw), math.sin(yaw)
    along = max((motion.x - x) * dx + (motion.y - y) * dy, 0.0)
    reach = along + max(MIN_AIM, motion.speed * LOOKAHEAD)
    return x + reach * dx, y + reach * dy


def _acceleration(
    motion: Motion, gap: tuple[float, float], planned_velocity: tuple[float, float]
) -> float:
    """Acceleration [m/s^2] to close ``gap`` [m] within the look-ahead time."""
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
    ahead, left = cos * gap[0] + sin * gap[1], cos * gap[1] - sin * gap[0]
    vx, vy = planned_velocity
    planned = math.copysign(math.hypot(vx, vy), vx * cos + vy * sin)
    lag = _arc_length(ahead, left) - planned * LOOKAHEAD
    lag = min(max(lag, -MAX_LAG), MAX_LAG)
    return 2 * (lag / LOOKAHEAD + planned - motion.speed) / LOOKAHEAD


def _arc_length(ahead: float, left: float) -> float:
    """Length of the arc that starts along x and ends at (ahead, left); negative when behind."""
    if ahead <= 0:
        return ahead
    angle = math.atan2(left, ahead)
    stretch = angle / math.sin(angle) if abs(angle) > 1e-4 else 1.0 + angle * angle / 6
    return math.hypot(ahead, left) * stretch
