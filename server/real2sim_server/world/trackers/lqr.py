"""Linear-quadratic regulators along and across a reference."""

from __future__ import annotations

import math
from dataclasses import dataclass

from real2sim_proto.episode import EgoSpec

from ..actuators import Command
from ..ego import Motion, drive
from ..reference import MOVING, Reference
from ..vehicle import vehicle_of

TIME = 0.6
"""Time scale of the regulator along the plan [s]: (r/q)^(1/4) of its weights."""

HEADWAY, SHORTEST = 0.55, 2.0
"""Length scale of the regulator across the plan: this many seconds of way, at least metres."""

GENTLE_BRAKING = 2.0
"""Deceleration after the plan's end [m/s^2]."""


@dataclass(frozen=True, eq=False)
class Lqr:
    """Two decoupled regulators, with the reference's own acceleration and curvature fed forward.

    Along the plan the error obeys e'' = a - a_ref in time; across it e'' = k - k_ref in path
    length, for small heading errors. Both are double integrators, whose Riccati equation for the
    cost q e^2 + r u^2 has the solution u = -(e/l^2 + sqrt(2) e'/l) with l = (r/q)^(1/4)
    (Anderson & Moore 1990, Optimal Control, ch. 3).

    Attributes:
        reference: what is followed.
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
            x, y, yaw = self.reference.last_pose
            point = Point(x, y, yaw, 0.0, 0.0, 0.0)
            return Command(-GENTLE_BRAKING, steering_onto(point, motion, self.spec))
        point = point_at(self.reference, t)
        along = (point.x - motion.x) * math.cos(point.yaw) + (point.y - motion.y) * math.sin(
            point.yaw
        )
        speed = motion.speed * math.cos(motion.yaw - point.yaw)
        acceleration = (
            point.acceleration + along / TIME**2 + math.sqrt(2) * (point.speed - speed) / TIME
        )
        return Command(acceleration, steering_onto(point, motion, self.spec))


@dataclass(frozen=True)
class Point:
    """A reference at one time: pose [m], [rad], speed [m/s], acceleration, curvature [1/m]."""

    x: float
    y: float
    yaw: float
    speed: float
    acceleration: float
    curvature: float


def point_at(reference: Reference, t: float, *, step: float = 0.05) -> Point:
    """The reference ``t`` seconds after its start, with derivatives over ``step`` seconds."""
    x, y, vx, vy = reference.planned(t)
    _, _, wx, wy = reference.planned(t + step)
    speed, later = math.hypot(vx, vy), math.hypot(wx, wy)
    if speed < MOVING:
        return Point(x, y, reference.heading(t), speed, (later - speed) / step, 0.0)
    yaw = math.atan2(vy, vx)
    turn = math.remainder(math.atan2(wy, wx) - yaw, math.tau) if later > MOVING else 0.0
    return Point(x, y, yaw, speed, (later - speed) / step, turn / (speed * step))


def steering_onto(point: Point, motion: Motion, spec: EgoSpec) -> float:
    """Road-wheel angle [rad] that brings the vehicle onto the path through ``point``."""
    dx, dy = motion.x - point.x, motion.y - point.y
    across = dy * math.cos(point.yaw) - dx * math.sin(point.yaw)
    # Where the vehicle really goes: with slipping tyres not quite where it points.
    course = motion.yaw + math.atan2(motion.lateral_speed, max(motion.speed, 1.0))
    heading = math.remainder(course - point.yaw, math.tau)
    scale = max(HEADWAY * motion.speed, SHORTEST)
    curvature = point.curvature - across / scale**2 - math.sqrt(2) * heading / scale
    rolling = math.atan(spec.wheelbase * curvature)
    if spec.dynamics == "kinematic_bicycle":
        return rolling
    return rolling + vehicle_of(spec).understeer * motion.speed**2 * curvature
