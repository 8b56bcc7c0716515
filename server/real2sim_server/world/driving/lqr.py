"""Linear-quadratic regulators along and across a plan."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..._numba import func
from .curve import MOVING, YAW, X, Y, heading, is_over, planned_at
from .state import GENTLE_BRAKING, Command, wrapped
from .vehicle_models import steady_steering

TIME = 0.6
"""Time scale of the regulator along the plan [s]: (r/q)^(1/4) of its weights."""

HEADWAY, SHORTEST = 0.55, 2.0
"""Length scale of the regulator across the plan: this many seconds of way, at least metres."""

DIFFERENCE = 0.05
"""Acceleration and curvature of the plan are taken over this time [s]."""


NEWTON_STEPS = 8
"""From the start that is taken, the gains are then exact for lags of up to ten times the scale."""


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
    Moore 1990, Optimal Control, ch. 3). Lags that are known are part of both, see
    :func:`lagging_gains`; what the plan itself needs is fed forward by as much earlier.
    """
    if is_over(curve, t):
        last = curve.knots[len(curve.knots) - 1]
        point = PlanPoint(last[X], last[Y], last[YAW], 0.0, 0.0, 0.0)
        return Command(-GENTLE_BRAKING, _steering_onto(point, 0.0, state, vehicle))
    point = point_at(curve, t, state.yaw, vehicle.tracker_version)
    along = (point.x - state.x) * math.cos(point.yaw) + (point.y - state.y) * math.sin(point.yaw)
    speed = state.speed * math.cos(state.yaw - point.yaw)
    by_speed, by_drive = lagging_gains(vehicle.known_drive_lag / TIME)
    acceleration = point.acceleration + along / TIME**2 + by_speed * (point.speed - speed) / TIME
    if vehicle.known_drive_lag > 0.0:
        later = point_at(curve, t + vehicle.known_drive_lag, state.yaw, vehicle.tracker_version)
        acceleration += later.acceleration - point.acceleration
        acceleration -= by_drive * (state.drive - point.acceleration)
    coming = point.curvature
    if vehicle.known_steering_lag > 0.0:
        steered = point_at(
            curve, t + vehicle.known_steering_lag, state.yaw, vehicle.tracker_version
        )
        coming = steered.curvature
    return Command(acceleration, _steering_onto(point, coming, state, vehicle))


@func
def lagging_gains(lag):
    """Gains of the regulator of a double integrator behind a lag of the first order.

    For e'' = a and lag a' = u - a with the cost e^2 + u^2 the optimal u is -(e + b e' + c a). The
    squares z of the closed loop's poles solve lag^2 z^3 = z^2 + 1 (symmetric root locus); its real
    root is w / lag^2 with w^3 = w^2 + lag^4.

    Args:
        lag: in units of the regulator's scale.

    Returns:
        b and c; sqrt(2) and 0 without a lag.
    """
    if lag == 0.0:
        return math.sqrt(2.0), 0.0
    fourth = lag**4
    w = 1.0 + min(fourth, fourth ** (1 / 3))
    for _ in range(NEWTON_STEPS):
        w -= (w * w * (w - 1.0) - fourth) / (w * (3.0 * w - 2.0))
    root = math.sqrt(w)
    # The other two poles are those of s^2 + b s + 1/sqrt(w), and the first is at -sqrt(w)/lag.
    pair = math.sqrt(2.0 / root - (lag / w) ** 2)
    return lag / root + pair * root, lag * pair + root - 1.0


@func
def point_at(curve, t, ahead, version):
    """The plan ``t`` seconds after its start, with derivatives.

    Args:
        curve: of the plan.
        t: [s].
        ahead: heading of the vehicle [rad].
        version: of the trackers; since 2 a plan that goes against that heading, as one does that
            the vehicle has run past, has a speed below 0.
    """
    x, y, vx, vy = planned_at(curve, t, version)
    _, _, wx, wy = planned_at(curve, t + DIFFERENCE, version)
    speed, later = math.hypot(vx, vy), math.hypot(wx, wy)
    if version > 1:
        cos, sin = math.cos(ahead), math.sin(ahead)
        back, back_later = vx * cos + vy * sin < 0.0, wx * cos + wy * sin < 0.0
        if back:
            speed, vx, vy = -speed, -vx, -vy
        if back_later:
            later, wx, wy = -later, -wx, -wy
    acceleration = (later - speed) / DIFFERENCE
    if abs(speed) < MOVING:
        return PlanPoint(x, y, heading(curve, t), speed, acceleration, 0.0)
    yaw = math.atan2(vy, vx)
    turn = wrapped(math.atan2(wy, wx) - yaw) if abs(later) > MOVING else 0.0
    return PlanPoint(x, y, yaw, speed, acceleration, turn / (speed * DIFFERENCE))


@func
def _steering_onto(point, coming, state, vehicle):
    """Road-wheel angle [rad] that brings the vehicle onto the path through ``point``, whose
    curvature is ``coming`` [1/m] once the steering gear has followed."""
    dx, dy = state.x - point.x, state.y - point.y
    across = dy * math.cos(point.yaw) - dx * math.sin(point.yaw)
    # Where the vehicle really goes: with slipping tyres not quite where it points.
    direction = state.yaw + math.atan2(state.lateral_speed, max(state.speed, 1.0))
    off = wrapped(direction - point.yaw)
    scale = max(HEADWAY * state.speed, SHORTEST)
    lag = vehicle.known_steering_lag * state.speed / scale
    by_heading, by_steering = lagging_gains(lag)
    curvature = coming - across / scale**2 - by_heading * off / scale
    steering = _steering_of(curvature, state.speed, vehicle)
    if lag > 0.0:
        steering -= by_steering * (
            state.steering - _steering_of(point.curvature, state.speed, vehicle)
        )
    return steering


@func
def _steering_of(curvature, speed, vehicle):
    """Road-wheel angle [rad] that keeps a curvature [1/m]."""
    rolling = math.atan(vehicle.wheelbase * curvature)
    return steady_steering(vehicle.model, rolling, curvature, speed, vehicle)
