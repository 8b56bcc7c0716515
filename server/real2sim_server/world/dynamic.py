"""The dynamic bicycle: two axles whose tyres slip, with load transfer and a friction limit."""

from __future__ import annotations

import math

from .vehicle import GRAVITY, Vehicle

SLOWEST, FASTER = 2.0, 4.0
"""Below the first speed slip angles mean nothing and the kinematic bicycle holds; between the two
its lateral motion fades into that of the tyres [m/s]."""

Rates = tuple[float, float, float, float, float, float]


def fiala(slip: float, stiffness: float, limit: float) -> float:
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
    share = stiffness * math.tan(slip) / (3 * limit)
    return 3 * limit * share * (1 - abs(share) + share * share / 3)


def axle_forces(
    vehicle: Vehicle,
    moving: tuple[float, float, float],
    *,
    steering: float,
    acceleration: float,
) -> tuple[float, float]:
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
    shift = acceleration * vehicle.height
    load_f = max(vehicle.mass * (GRAVITY * vehicle.rear - shift) / vehicle.wheelbase, 0.0)
    load_r = max(vehicle.mass * (GRAVITY * vehicle.front + shift) / vehicle.wheelbase, 0.0)
    used = acceleration / GRAVITY
    left = math.sqrt(max(vehicle.friction**2 - used * used, 0.0))
    slip_f = steering - math.atan2(vy + vehicle.front * turn, vx)
    slip_r = -math.atan2(vy - vehicle.rear * turn, vx)
    return (
        fiala(slip_f, vehicle.front_cornering * load_f, left * load_f) if load_f else 0.0,
        fiala(slip_r, vehicle.rear_cornering * load_r, left * load_r) if load_r else 0.0,
    )


def rates(
    vehicle: Vehicle,
    state: tuple[float, float, float, float, float, float],
    steering: float,
    acceleration: float,
) -> Rates:
    """Time derivative of (x, y, yaw, vx, vy, yaw rate) of the centre of mass."""
    _, _, yaw, vx, vy, turn = state
    front, rear = axle_forces(vehicle, (vx, vy, turn), steering=steering, acceleration=acceleration)
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


def integrate(
    vehicle: Vehicle,
    state: tuple[float, float, float, float, float, float],
    steering: tuple[float, float],
    acceleration: float,
    h: float,
) -> tuple[float, float, float, float, float, float]:
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
    k1 = rates(vehicle, state, begin, acceleration)
    k2 = rates(vehicle, _moved(state, k1, h / 2), middle, acceleration)
    k3 = rates(vehicle, _moved(state, k2, h / 2), middle, acceleration)
    k4 = rates(vehicle, _moved(state, k3, h), end, acceleration)
    mean = tuple((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
    return _moved(state, mean, h)


def tyre_share(speed: float) -> float:
    """How much of the lateral motion is that of the tyres, 0 to 1; the rest is rolling."""
    return min(max((speed - SLOWEST) / (FASTER - SLOWEST), 0.0), 1.0)


def _moved(
    state: tuple[float, ...], rate: tuple[float, ...], h: float
) -> tuple[float, float, float, float, float, float]:
    x, y, yaw, vx, vy, turn = (s + h * r for s, r in zip(state, rate, strict=True))
    return x, y, yaw, vx, vy, turn
