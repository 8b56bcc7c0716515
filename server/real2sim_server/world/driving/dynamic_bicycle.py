"""The dynamic bicycle: two axles on tyres that slip; rolls where it is slow."""

from __future__ import annotations

import math

from ..._numba import func
from .kinematic_bicycle import rolled
from .state import PlanarState, clamped
from .tyres import integrate, tyre_weight
from .vehicle import GRAVITY


@func
def step_slipping(state, command, vehicle, h):
    """The vehicle ``h`` seconds later; fades into the kinematic bicycle where it is slow."""
    most = vehicle.friction * GRAVITY
    limited = clamped(command.acceleration, -most, most)
    rolling = rolled(state, command, limited, vehicle, h)
    weight = tyre_weight(min(state.speed, rolling.speed))
    if weight == 0.0:
        return rolling
    cos, sin = math.cos(state.yaw), math.sin(state.yaw)
    centre = (
        state.x + vehicle.rear * cos,
        state.y + vehicle.rear * sin,
        state.yaw,
        state.speed,
        state.lateral_speed + vehicle.rear * state.yaw_rate,
        state.yaw_rate,
    )
    acceleration = (rolling.speed - state.speed) / h
    steering = (state.steering, rolling.steering)
    x, y, yaw, vx, vy, turn = integrate(vehicle, centre, steering, acceleration, h)
    rest = 1 - weight
    return PlanarState(
        weight * (x - vehicle.rear * math.cos(yaw)) + rest * rolling.x,
        weight * (y - vehicle.rear * math.sin(yaw)) + rest * rolling.y,
        weight * yaw + rest * rolling.yaw,
        weight * max(vx, 0.0) + rest * rolling.speed,
        0.0,
        rolling.steering,
        weight * turn + rest * rolling.yaw_rate,
        weight * (vy - vehicle.rear * turn),
        command.acceleration,
    )


@func
def understeer_steering(rolling, curvature, speed, vehicle):
    """Road-wheel angle [rad] that keeps a curvature: more than that of wheels that roll, by the
    understeer at the lateral acceleration."""
    return rolling + vehicle.understeer * speed**2 * curvature
