"""LiDAR from Gaussians: rays followed in 3D, one origin and pose for each instant of a sweep.

``cast`` gives what the light of each ray meets (an :class:`Echo`), ``detect`` what the sensor makes
of it (a :class:`Sweep`). Nothing here is compiled before the first call.
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
