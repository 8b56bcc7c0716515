"""Pure pursuit: aim at where the plan will be."""

from __future__ import annotations

import math

from ..._numba import func
from .curve import MOVING, YAW, X, Y, at, end_of, heading, is_over
from .state import GENTLE_BRAKING, Command, PlanarState, clamped
from .vehicle_models import steady_steering

LOOKAHEAD = 0.4
"""The controller aims at where the plan is this much later [s]."""

MIN_AIM = 3.0
"""Steering aims at least this far ahead; nearer aims would turn centimetres into angles [m]."""

AIM_TRIES = 8
MAX_LAG = 2.0
"""Distance behind or ahead of the plan beyond which the controller hurries no more [m]."""


@func
def pursue(state, curve, t, vehicle, _schedule):
    """What to do, ``t`` seconds after the plan's start.

    Steering is pure pursuit (Coulter 1992, CMU-RI-TR-92-01): the arc that ends at the aim. The
    aim lies on the plan, so the arc carries the plan's curvature. Acceleration is what brings the
    vehicle to where the plan is after the look-ahead time T, from s = v T + a T^2 / 2; with its
    two gains 2 / T^2 and 2 / T the lag behind a moving plan decays with damping 0.7. Lags that are
    known count as dead times: each command is for where the vehicle will be after its lag.
    """
    if is_over(curve, t):
        last = curve.knots[len(curve.knots) - 1]
        x, y = _straight_on(state, last[X], last[Y], last[YAW])
        return Command(-GENTLE_BRAKING, _steering(state, x, y, vehicle))
    after = t + LOOKAHEAD + vehicle.known_drive_lag
    x, y, vx, vy = at(curve, after)
    there = _coasted(state, vehicle.known_drive_lag)
    acceleration = _acceleration(there, x - there.x, y - there.y, vx, vy)
    if vehicle.known_steering_lag != vehicle.known_drive_lag:
        after = t + LOOKAHEAD + vehicle.known_steering_lag
        x, y, _, _ = at(curve, after)
        there = _coasted(state, vehicle.known_steering_lag)
    if math.hypot(x - there.x, y - there.y) < MIN_AIM:
        x, y = _farther_aim(there, curve, after)
    return Command(acceleration, _steering(there, x, y, vehicle))


@func
def _coasted(state, seconds):
    """The vehicle some time later, were its drive and its turn rate per way to stay as they are."""
    if seconds == 0.0:
        return state
    speed = max(state.speed + state.drive * seconds, 0.0)
    way = (state.speed + speed) / 2 * seconds
    turn = state.yaw_rate * way / state.speed if state.speed > MOVING else 0.0
    heading_there = state.yaw + turn / 2
    sideways = state.lateral_speed * seconds
    cos, sin = math.cos(heading_there), math.sin(heading_there)
    return PlanarState(
        state.x + way * cos - sideways * sin,
        state.y + way * sin + sideways * cos,
        state.yaw + turn,
        speed,
        state.acceleration,
        state.steering,
        state.yaw_rate,
        state.lateral_speed,
        state.drive,
    )


@func
def _steering(state, x, y, vehicle):
    """Road-wheel angle [rad] of the arc from the rear axle to (x, y)."""
    dx, dy = x - state.x, y - state.y
    left = math.cos(state.yaw) * dy - math.sin(state.yaw) * dx
    curvature = 2 * left / (dx * dx + dy * dy)
    rolling = math.atan(vehicle.wheelbase * curvature)
    return steady_steering(vehicle.model, rolling, curvature, state.speed, vehicle)


@func
def _farther_aim(state, curve, t):
    """The first place of the plan after ``t`` that is far enough.

    Where the plan stops before that, a place on the line straight on from where it stands.
    """
    x, y = state.x, state.y
    for _ in range(AIM_TRIES):
        t = min(t + LOOKAHEAD, end_of(curve))
        x, y, _, _ = at(curve, t)
        if math.hypot(x - state.x, y - state.y) >= MIN_AIM:
            return x, y
    return _straight_on(state, x, y, heading(curve, t))


@func
def _straight_on(state, x, y, yaw):
    """A place to aim at, on the line from (x, y) along ``yaw``."""
    dx, dy = math.cos(yaw), math.sin(yaw)
    along = max((state.x - x) * dx + (state.y - y) * dy, 0.0)
    reach = along + max(MIN_AIM, state.speed * LOOKAHEAD)
    return x + reach * dx, y + reach * dy


@func
def _acceleration(state, dx, dy, vx, vy):
    """Acceleration [m/s^2] to close a gap [m] to a plan of a velocity [m/s] in the look-ahead
    time; both in the world."""
    cos, sin = math.cos(state.yaw), math.sin(state.yaw)
    ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
    planned = math.copysign(math.hypot(vx, vy), vx * cos + vy * sin)
    lag = clamped(_arc_length(ahead, left) - planned * LOOKAHEAD, -MAX_LAG, MAX_LAG)
    return 2 * (lag / LOOKAHEAD + planned - state.speed) / LOOKAHEAD


@func
def _arc_length(ahead, left):
    """Length of the arc that starts along x and ends at (ahead, left); negative when behind."""
    if ahead <= 0:
        return ahead
    angle = math.atan2(left, ahead)
    stretch = angle / math.sin(angle) if abs(angle) > 1e-4 else 1.0 + angle * angle / 6
    return math.hypot(ahead, left) * stretch
