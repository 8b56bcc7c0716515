"""Compiled dynamics and trackers of the controlled vehicle.

All functions take and return floats, tuples and arrays. Python calls :mod:`.entries`, which selects
a model of :mod:`.vehicle` and a tracker of :mod:`.trackers`.
"""

from .curve import MOVING, NO_POSE
from .entries import (
    NO_SCHEDULE,
    advance_vehicle,
    curve_at,
    driver_command,
    placed_poses,
    plan_curve,
    prepare_schedule,
)
from .trackers import HOLD, ILQR, KINDS, LQR, PLANNING_AHEAD, PURSUIT
from .vehicle import (
    GRAVITY,
    VEHICLE_MODELS,
    Command,
    PlanarState,
    VehicleModel,
    VehicleParameters,
    vehicle_parameters,
    wheel_load,
)

__all__ = [
    "GRAVITY",
    "HOLD",
    "ILQR",
    "KINDS",
    "LQR",
    "MOVING",
    "NO_POSE",
    "NO_SCHEDULE",
    "PLANNING_AHEAD",
    "PURSUIT",
    "VEHICLE_MODELS",
    "Command",
    "PlanarState",
    "VehicleModel",
    "VehicleParameters",
    "advance_vehicle",
    "curve_at",
    "driver_command",
    "placed_poses",
    "plan_curve",
    "prepare_schedule",
    "vehicle_parameters",
    "wheel_load",
]
