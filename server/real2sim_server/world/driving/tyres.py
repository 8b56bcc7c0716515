"""The dynamic bicycle: two axles whose tyres slip, with load transfer and a friction limit."""

from __future__ import annotations

import math

from ..._numba import func
from .state import clamped
from .vehicle import GRAVITY, wheel_load

_wheel_load = func(wheel_load)

SLOWEST, FASTER = 2.0, 4.0
"""Below the first speed slip angles mean nothing and the kinematic bicycle holds; between the two
its lateral motion fades into that of the tyres [m/s]."""


@func
def tyre_weight(speed):
    """Weight of the tyres' lateral motion, 0 to 1; the rest is rolling."""
    return clamped((speed - SLOWEST) / (FASTER - SLOWEST), 0.0, 1.0)


@func
def integrate(vehicle, state, steering, acceleration, h):
    """The state ``h`` seconds later, by the classical Runge-Kutta method.

    Args:
        vehicle: constants.
        state: of the centre of mass, see :func:`rates`.
        steering: at the beginning and the end; in between it moves linearly [rad].
        acceleration: by engine or brakes [m/s^2].
        h: at most 10 ms; the fastest motion is that of the tyres, about 1/(60 vx) s.
    """
    begin, end = steering
    middle = (begin + end) / 2
    a = rates(vehicle, state, begin, acceleration)
    b = rates(vehicle, _integrated(state, a, h / 2), middle, acceleration)
    c = rates(vehicle, _integrated(state, b, h / 2), middle, acceleration)
    d = rates(vehicle, _integrated(state, c, h), end, acceleration)
    mean = (
        (a[0] + 2 * b[0] + 2 * c[0] + d[0]) / 6,
        (a[1] + 2 * b[1] + 2 * c[1] + d[1]) / 6,
        (a[2] + 2 * b[2] + 2 * c[2] + d[2]) / 6,
        (a[3] + 2 * b[3] + 2 * c[3] + d[3]) / 6,
        (a[4] + 2 * b[4] + 2 * c[4] + d[4]) / 6,
        (a[5] + 2 * b[5] + 2 * c[5] + d[5]) / 6,
    )
    return _integrated(state, mean, h)


@func
def rates(vehicle, state, steering, acceleration):
    """Time derivative of (x, y, yaw, vx, vy, yaw rate) of the centre of mass: place and heading in
    the world, velocity in the vehicle frame."""
    _, _, yaw, vx, vy, turn = state
    front, rear = axle_forces(vehicle, (vx, vy, turn), steering, acceleration)
    cos, sin = math.cos(yaw), math.sin(yaw)
    across = front * math.cos(steering)
    return (
        vx * cos - vy * sin,
        vx * sin + vy * cos,
        turn,
        acceleration - front * math.sin(steering) / vehicle.mass + vy * turn,
        (across + rear) / vehicle.mass - vx * turn,
        (vehicle.front * across - vehicle.rear * rear) / vehicle.inertia,
    )


@func
def axle_forces(vehicle, moving, steering, acceleration):
    """Lateral forces [N] of front and rear axle, each across its wheels.

    Loads shift with the longitudinal acceleration, whose force is shared by load, so that each
    axle's friction circle leaves it the same part for cornering.

    Args:
        vehicle: constants.
        moving: velocity of the centre of mass in the vehicle frame [m/s], forward above 0, and
            yaw rate [rad/s].
        steering: road-wheel angle [rad].
        acceleration: by engine or brakes, at most friction times gravity [m/s^2].
    """
    vx, vy, turn = moving
    mass, height, wheelbase = vehicle.mass, vehicle.height, vehicle.wheelbase
    load_f = _wheel_load(mass, height, wheelbase, vehicle.rear, acceleration)
    load_r = _wheel_load(mass, height, wheelbase, vehicle.front, -acceleration)
    used = acceleration / GRAVITY
    left = math.sqrt(max(vehicle.friction**2 - used * used, 0.0))
    slip_f = steering - math.atan2(vy + vehicle.front * turn, vx)
    slip_r = -math.atan2(vy - vehicle.rear * turn, vx)
    return (
        fiala(slip_f, vehicle.front_cornering * load_f, left * load_f),
        fiala(slip_r, vehicle.rear_cornering * load_r, left * load_r),
    )


@func
def fiala(slip, stiffness, limit):
    """Lateral force [N] of a tyre: linear for small slip, ``limit`` when it slides.

    The brush model with parabolic pressure (Fiala 1954; Pacejka 2012, Tire and Vehicle Dynamics,
    eq. 3.11).

    Args:
        slip: angle from the wheel's motion to its heading [rad]; the force has its sign.
        stiffness: at zero slip [N/rad].
        limit: friction times load, less what the longitudinal force takes [N].
    """
    if limit <= 0.0:
        return 0.0
    if abs(slip) >= math.atan(3 * limit / stiffness):
        return math.copysign(limit, slip)
    sliding = stiffness * math.tan(slip) / (3 * limit)
    return 3 * limit * sliding * (1 - abs(sliding) + sliding * sliding / 3)


@func
def _integrated(state, rate, h):
    x, y, yaw, vx, vy, turn = state
    return (
        x + h * rate[0],
        y + h * rate[1],
        yaw + h * rate[2],
        vx + h * rate[3],
        vy + h * rate[4],
        turn + h * rate[5],
    )
