"""The family of vehicle models: what ``EgoSpec.dynamics`` names.

A model is two compiled functions, see :class:`VehicleModel`; a new one is a module with these and
a line of :data:`VEHICLE_MODELS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from real2sim_proto.episode import EgoSpec

from ..per_object import per_object
from .dispatch import choice
from .dynamic_bicycle import step_slipping, understeer_steering
from .kinematic_bicycle import rolling_steering, step_rolling
from .vehicle import GRAVITY, VehicleParameters


class VehicleModel(NamedTuple):
    """How a vehicle moves; both are made by :func:`real2sim_server._numba.func`.

    Attributes:
        step: ``step(state, command, vehicle, h)``, the :class:`.state.PlanarState` ``h`` seconds
            later (at most 10 ms) under a :class:`.state.Command` that has reached the wheels, for
            :class:`.vehicle.VehicleParameters`; holds their limits.
        steady_steering: ``steady_steering(rolling, curvature, speed, vehicle)``, the road-wheel
            angle [rad] that keeps a curvature [1/m] at a speed [m/s], where wheels that only roll
            would need the angle ``rolling``. Trackers steer by it.
        backwards: name of the model whose mirror image drives backwards in its place, at the low
            speeds of a reverse gear; None for a model that cannot.
    """

    step: Any
    steady_steering: Any
    backwards: str | None = "kinematic_bicycle"


VEHICLE_MODELS: Mapping[str, VehicleModel] = {
    "kinematic_bicycle": VehicleModel(step_rolling, rolling_steering),
    "dynamic_bicycle": VehicleModel(step_slipping, understeer_steering),
}
"""By the name of ``EgoSpec.dynamics``; the number of a model is its place."""

step_vehicle = choice([model.step for model in VEHICLE_MODELS.values()])
steady_steering = choice([model.steady_steering for model in VEHICLE_MODELS.values()])


@per_object
@lru_cache(maxsize=256)
def vehicle_parameters(spec: EgoSpec) -> VehicleParameters:
    """The constants of a spec."""
    figures, actuators = spec.vehicle, spec.actuators
    front = (1 - figures.front_load) * spec.wheelbase
    rear = figures.front_load * spec.wheelbase
    # k^2 / (a b) is close to 1 for passenger cars (Heydinger et al. 1999, SAE 1999-01-1336).
    inertia = figures.yaw_inertia or figures.mass * front * rear
    lags = {
        "steering_delay": actuators.steering_delay_us * 1e-6,
        "steering_lag": actuators.steering_lag,
        "drive_delay": actuators.drive_delay_us * 1e-6,
        "drive_lag": actuators.drive_lag,
    }
    known = {f"known_{name}": value * actuators.foreseen for name, value in lags.items()}
    return VehicleParameters(
        model=list(VEHICLE_MODELS).index(spec.dynamics),
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
        **lags,
        **known,
        tracker_version=spec.tracker_version,
    )
