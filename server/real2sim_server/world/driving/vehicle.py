"""Constants of the controlled vehicle, derived once from its spec."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from real2sim_proto.episode import EgoSpec

GRAVITY = 9.81


class VehicleParameters(NamedTuple):
    """A car as two axles that carry a mass, with the limits of what moves and steers it.

    Attributes:
        slips: whether its tyres slip; without, its wheels go where they point.
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
    """

    slips: bool
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


@lru_cache(maxsize=256)
def vehicle_parameters(spec: EgoSpec) -> VehicleParameters:
    """The constants of a spec."""
    figures, actuators = spec.vehicle, spec.actuators
    front = (1 - figures.front_load) * spec.wheelbase
    rear = figures.front_load * spec.wheelbase
    # k^2 / (a b) is close to 1 for passenger cars (Heydinger et al. 1999, SAE 1999-01-1336).
    inertia = figures.yaw_inertia or figures.mass * front * rear
    return VehicleParameters(
        slips=spec.dynamics == "dynamic_bicycle",
        wheelbase=spec.wheelbase,
        mass=figures.mass,
        inertia=inertia,
        front=front,
        rear=rear,
        height=figures.centre_height,
        friction=figures.friction,
        front_cornering=figures.front_cornering,
        rear_cornering=figures.rear_cornering,
        understeer=(1 / figures.front_cornering - 1 / figures.rear_cornering) / GRAVITY,
        max_steer=spec.max_steer,
        max_steer_rate=spec.max_steer_rate,
        max_acceleration=spec.max_acceleration,
        max_braking=spec.max_braking,
        max_speed=spec.max_speed,
        steering_delay=actuators.steering_delay_us * 1e-6,
        steering_lag=actuators.steering_lag,
        drive_delay=actuators.drive_delay_us * 1e-6,
        drive_lag=actuators.drive_lag,
    )
