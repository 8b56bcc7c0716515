"""LiDARs and radars of an episode: those that a reset names (:mod:`.mounted`), the way that all has
come since their last sweep (:mod:`.wake`), and what they give (:mod:`.cloud`). What they measure is
in ``sensing``."""

from .cloud import Cloud, in_frame
from .mounted import (
    NO_SENSORS,
    Mounted,
    MountedLidar,
    MountedRadar,
    RangingSensors,
    mounted_sensors,
)
from .wake import StepWay, Wake

__all__ = [
    "NO_SENSORS",
    "Cloud",
    "Mounted",
    "MountedLidar",
    "MountedRadar",
    "RangingSensors",
    "StepWay",
    "Wake",
    "in_frame",
    "mounted_sensors",
]
