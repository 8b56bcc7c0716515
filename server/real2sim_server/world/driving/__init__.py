"""How the controlled vehicle moves and steers: plain functions, compiled.

Everything here takes and gives floats, tuples and arrays. :mod:`.entries` is what Python calls;
:mod:`.vehicle_models` and :mod:`.trackers` are the families that it chooses from.
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
