"""How the controlled vehicle moves and steers: plain functions, compiled.

Everything here takes and gives floats, tuples and arrays. :mod:`.entries` is what Python calls; the
other files hold what that is made of.
"""

from .curve import MOVING
from .entries import (
    HOLD,
    ILQR,
    LQR,
    PURSUIT,
    advance_vehicle,
    curve_at,
    driver_command,
    plan_curve,
    world_poses,
)
from .state import Command, PlanarState
from .vehicle import GRAVITY, VehicleParameters, vehicle_parameters

__all__ = [
    "GRAVITY",
    "HOLD",
    "ILQR",
    "LQR",
    "MOVING",
    "PURSUIT",
    "Command",
    "PlanarState",
    "VehicleParameters",
    "advance_vehicle",
    "curve_at",
    "driver_command",
    "plan_curve",
    "vehicle_parameters",
    "world_poses",
]
