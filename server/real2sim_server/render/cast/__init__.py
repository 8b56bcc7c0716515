"""LiDAR ray casting through Gaussians, in 3D, with a sensor pose for each instant of a sweep.

``cast`` computes the light that each ray returns (an :class:`Echo`), ``detect`` the measurements of
the sensor (a :class:`Sweep`). Kernels are compiled on the first call.
"""

from .call import (
    SweepScene,
    cast,
    prepare_rays,
    recorded_scene,
    recorded_sweep,
    select_caster,
    sensor_poses,
)
from .sensors import Sweep, detect
from .types import CastBackend, CastRequest, Echo, Return

__all__ = [
    "CastBackend",
    "CastRequest",
    "Echo",
    "Return",
    "Sweep",
    "SweepScene",
    "cast",
    "detect",
    "prepare_rays",
    "recorded_scene",
    "recorded_sweep",
    "select_caster",
    "sensor_poses",
]
