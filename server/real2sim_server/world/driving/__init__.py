"""How the controlled vehicle moves and steers: plain functions, compiled.

Everything here takes and gives floats, tuples and arrays. :mod:`.entries` is what Python calls; the
other files hold what that is made of.
"""

from .curve import MOVING
from .entries import HOLD, ILQR, LQR, PURSUIT, asked_of, curve_at, driven, plan_curve, world_poses
from .state import Command, PlanarState
from .vehicle import GRAVITY, Vehicle, vehicle_of

__all__ = [
    "GRAVITY",
    "HOLD",
    "ILQR",
    "LQR",
    "MOVING",
    "PURSUIT",
    "Command",
    "PlanarState",
    "Vehicle",
    "asked_of",
    "curve_at",
    "driven",
    "plan_curve",
    "vehicle_of",
    "world_poses",
]
