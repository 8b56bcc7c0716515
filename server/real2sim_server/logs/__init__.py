"""Driving logs: one reader per dataset and the synthetic generator, behind one DrivingLog type.

The generator is in ``real2sim_server.synthetic``. It compiles kernels, so this package does not
import it.
"""

from .check import LogCheck, check_log, usable_log
from .driving_log import (
    ChecksFiles,
    DrivingLog,
    FrameSource,
    LidarSweep,
    LogError,
    LoggedMap,
    LogSelection,
    ObjectTrack,
    log_of_frames,
    same_part,
    select_from_log,
)
from .inspect import CameraReport, LogReport, inspect_log
from .open import open_log
from .readers.native import write_native_log

__all__ = [
    "CameraReport",
    "ChecksFiles",
    "DrivingLog",
    "FrameSource",
    "LidarSweep",
    "LogCheck",
    "LogError",
    "LogReport",
    "LogSelection",
    "LoggedMap",
    "ObjectTrack",
    "check_log",
    "inspect_log",
    "log_of_frames",
    "open_log",
    "same_part",
    "select_from_log",
    "usable_log",
    "write_native_log",
]
