"""One substep of the vehicle: wheels that roll, or slip on their tyres."""

from __future__ import annotations

import math

from ..._numba import func
from .state import PlanarState, clamped
from .tyres import integrate, tyre_share
from .vehicle import GRAVITY


@func
def moved_on(state, command, vehicle, h):
    """The vehicle ``h`` seconds later."""
    if not vehicle.slips:
        return _rolled(state, command, command.acceleration, vehicle, h)
    return _slipped(state, command, vehicle, h)


@func
def _rolled(state, command, acceleration, vehicle, h):
    """Kinematic bicycle: wheels go where they point; what brings ``acceleration`` about may be
    asked for more."""
    steering = _steered(state.steering, command.steering, vehicle, h)
    speed, distance = _sped_up(state.speed, acceleration, vehicle, h)
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
def _slipped(state, command, vehicle, h):
    """Dynamic bicycle; fades into the kinematic one where it is slow."""
    most = vehicle.friction * GRAVITY
    limited = clamped(command.acceleration, -most, most)
    rolled = _rolled(state, command, limited, vehicle, h)
    share = tyre_share(min(state.speed, rolled.speed))
    if share == 0.0:
        return rolled
    cos, sin = math.cos(state.yaw), math.sin(state.yaw)
    centre = (
        state.x + vehicle.rear * cos,
        state.y + vehicle.rear * sin,
        state.yaw,
        state.speed,
        state.lateral_speed + vehicle.rear * state.yaw_rate,
        state.yaw_rate,
    )
    acceleration = (rolled.speed - state.speed) / h
    steering = (state.steering, rolled.steering)
    x, y, yaw, vx, vy, turn = integrate(vehicle, centre, steering, acceleration, h)
    rest = 1 - share
    return PlanarState(
        share * (x - vehicle.rear * math.cos(yaw)) + rest * rolled.x,
        share * (y - vehicle.rear * math.sin(yaw)) + rest * rolled.y,
        share * yaw + rest * rolled.yaw,
        share * max(vx, 0.0) + rest * rolled.speed,
        0.0,
        rolled.steering,
        share * turn + rest * rolled.yaw_rate,
        share * (vy - vehicle.rear * turn),
        command.acceleration,
    )


@func
def _steered(steering, wanted, vehicle, h):
    most = vehicle.max_steer_rate * h
    wanted = clamped(wanted, -vehicle.max_steer, vehicle.max_steer)
    return steering + clamped(wanted - steering, -most, most)


@func
def _sped_up(speed, wanted, vehicle, h):
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
