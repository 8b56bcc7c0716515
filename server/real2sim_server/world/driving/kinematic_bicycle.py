"""The kinematic bicycle: wheels go where they point."""

from __future__ import annotations

import math

from ..._numba import func
from .state import PlanarState, clamped


@func
def step_rolling(state, command, vehicle, h):
    """The vehicle ``h`` seconds later."""
    return rolled(state, command, command.acceleration, vehicle, h)


@func
def rolling_steering(rolling, _curvature, _speed, _vehicle):
    """Road-wheel angle [rad] that keeps a curvature: that of wheels that roll."""
    return rolling


@func
def rolled(state, command, acceleration, vehicle, h):
    """Kinematic bicycle: wheels go where they point; what brings ``acceleration`` about may be
    asked for more."""
    steering = _limited_steering(state.steering, command.steering, vehicle, h)
    speed, distance = _limited_speed(state.speed, acceleration, vehicle, h)
    curvature = math.tan((state.steering + steering) / 2) / vehicle.wheelbase
    turn = distance * curvature
    chord = distance * sinc(turn / 2)
    heading = state.yaw + turn / 2
    return PlanarState(
        state.x + chord * math.cos(heading),
        state.y + chord * math.sin(heading),
        state.yaw + turn,
        speed,
        0.0,
        steering,
        speed * math.tan(steering) / vehicle.wheelbase,
        0.0,
        command.acceleration,
    )


@func
def _limited_steering(steering, wanted, vehicle, h):
    most = vehicle.max_steer_rate * h
    wanted = clamped(wanted, -vehicle.max_steer, vehicle.max_steer)
    return steering + clamped(wanted - steering, -most, most)


@func
def _limited_speed(speed, wanted, vehicle, h):
    """Speed after ``h`` seconds and distance covered; linear in time until a limit is met."""
    acceleration = clamped(wanted, -vehicle.max_braking, vehicle.max_acceleration)
    if acceleration == 0.0:
        return speed, speed * h
    limit = max(vehicle.max_speed, speed) if acceleration > 0 else min(0.0, speed)
    until_limit = (limit - speed) / acceleration
    if until_limit >= h:
        end = speed + acceleration * h
        return end, (speed + end) / 2 * h
    return limit, (speed + limit) / 2 * until_limit + limit * (h - until_limit)


@func
def sinc(angle):
    """sin(angle) / angle, by its series near 0 where the quotient loses its digits."""
    if abs(angle) < 1e-4:
        return 1.0 - angle * angle / 6.0
    return math.sin(angle) / angle
