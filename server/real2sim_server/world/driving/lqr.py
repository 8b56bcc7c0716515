"""Linear-quadratic regulators along and across a plan."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..._numba import func
from .curve import MOVING, YAW, X, Y, end_of, heading, planned_at
from .state import GENTLE_BRAKING, Command, wrapped
from .vehicle_models import steady_steering

TIME = 0.6
"""Time scale of the regulator along the plan [s]: (r/q)^(1/4) of its weights."""

HEADWAY, SHORTEST = 0.55, 2.0
"""Length scale of the regulator across the plan: this many seconds of way, at least metres."""

DIFFERENCE = 0.05
"""Acceleration and curvature of the plan are taken over this time [s]."""


class PlanPoint(NamedTuple):
    """A plan at one time: pose [m], [rad], speed [m/s], acceleration, curvature [1/m]."""

    x: float
    y: float
    yaw: float
    speed: float
    acceleration: float
    curvature: float


@func
def regulate(state, curve, t, vehicle, _schedule):
    """What to do, ``t`` seconds after the plan's start.

    Two decoupled regulators, with the plan's own acceleration and curvature fed forward. Along
    the plan the error obeys e'' = a - a_ref in time; across it e'' = k - k_ref in path length,
    for small heading errors. Both are double integrators, whose Riccati equation for the cost
    q e^2 + r u^2 has the solution u = -(e/l^2 + sqrt(2) e'/l) with l = (r/q)^(1/4) (Anderson &
    Moore 1990, Optimal Control, ch. 3).
    """
    if t >= end_of(curve):
        last = curve.knots[len(curve.knots) - 1]
        point = PlanPoint(last[X], last[Y], last[YAW], 0.0, 0.0, 0.0)
        return Command(-GENTLE_BRAKING, _steering_onto(point, state, vehicle))
    point = point_at(curve, t)
    along = (point.x - state.x) * math.cos(point.yaw) + (point.y - state.y) * math.sin(point.yaw)
    speed = state.speed * math.cos(state.yaw - point.yaw)
    acceleration = (
        point.acceleration + along / TIME**2 + math.sqrt(2.0) * (point.speed - speed) / TIME
    )
    return Command(acceleration, _steering_onto(point, state, vehicle))


@func
def point_at(curve, t):
    """The plan ``t`` seconds after its start, with derivatives."""
    x, y, vx, vy = planned_at(curve, t)
    _, _, wx, wy = planned_at(curve, t + DIFFERENCE)
    speed, later = math.hypot(vx, vy), math.hypot(wx, wy)
    acceleration = (later - speed) / DIFFERENCE
    if speed < MOVING:
        return PlanPoint(x, y, heading(curve, t), speed, acceleration, 0.0)
    yaw = math.atan2(vy, vx)
    turn = wrapped(math.atan2(wy, wx) - yaw) if later > MOVING else 0.0
    return PlanPoint(x, y, yaw, speed, acceleration, turn / (speed * DIFFERENCE))


@func
def _steering_onto(point, state, vehicle):
    """Road-wheel angle [rad] that brings the vehicle onto the path through ``point``."""
    dx, dy = state.x - point.x, state.y - point.y
    across = dy * math.cos(point.yaw) - dx * math.sin(point.yaw)
    # Where the vehicle really goes: with slipping tyres not quite where it points.
    direction = state.yaw + math.atan2(state.lateral_speed, max(state.speed, 1.0))
    off = wrapped(direction - point.yaw)
    scale = max(HEADWAY * state.speed, SHORTEST)
    curvature = point.curvature - across / scale**2 - math.sqrt(2.0) * off / scale
    rolling = math.atan(vehicle.wheelbase * curvature)
    return steady_steering(vehicle.model, rolling, curvature, state.speed, vehicle)
