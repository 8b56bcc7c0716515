"""Constants of the controlled vehicle."""

from __future__ import annotations

from typing import NamedTuple

GRAVITY = 9.81


def wheel_load(mass: float, height: float, base: float, arm: float, acceleration: float) -> float:
    """Load [N] on the wheels at one end of a base, of a mass that accelerates towards that end.

    The one formula of load transfer: of tyres along the vehicle, of the suspension along and
    across it. Compiled code takes it through :func:`real2sim_server._numba.func`.

    Args:
        mass: [kg].
        height: of the centre of mass [m].
        base: between the two ends [m].
        arm: from the other end to the centre of mass [m].
        acceleration: [m/s^2].
    """
    return max(mass * (GRAVITY * arm - acceleration * height) / base, 0.0)


class VehicleParameters(NamedTuple):
    """A car as two axles that carry a mass, with the limits of what moves and steers it.

    Attributes:
        model: number of its model, see :mod:`.vehicle_models`.
        wheelbase: [m].
        mass: [kg].
        inertia: about the vertical axis through the centre of mass [kg m^2].
        front, rear: distance of each axle from the centre of mass [m].
        height: of the centre of mass [m].
        friction: of tyres on the road.
        front_cornering, rear_cornering: lateral force per load and slip angle [1/rad].
        understeer: steering angle beyond L/R per lateral acceleration [rad s^2/m]: m/L (b/C_f -
            a/C_r) (Gillespie 1992, eq. 6-15) with stiffnesses in proportion to the loads at rest,
            where the geometry cancels out.
        max_steer, max_steer_rate: of the road wheels [rad], [rad/s].
        max_acceleration, max_braking: [m/s^2].
        max_speed: [m/s].
        steering_delay, drive_delay: dead times of commands [s].
        steering_lag, drive_lag: time constants of the first order [s].
        known_steering_delay, known_steering_lag, known_drive_delay, known_drive_lag: what trackers
            take these four to be [s]: the same, or 0 where they know nothing of them.
        tracker_version: of the trackers, see ``EgoSpec``.
    """

    model: int
    wheelbase: float
    mass: float
    inertia: float
    front: float
    rear: float
    height: float
    friction: float
    front_cornering: float
    rear_cornering: float
    understeer: float
    max_steer: float
    max_steer_rate: float
    max_acceleration: float
    max_braking: float
    max_speed: float
    steering_delay: float
    steering_lag: float
    drive_delay: float
    drive_lag: float
    known_steering_delay: float
    known_steering_lag: float
    known_drive_delay: float
    known_drive_lag: float
    tracker_version: int
