"""Driving logs: one reader per dataset and the synthetic generator, behind one DrivingLog type."""

from .driving_log import DrivingLog, FrameSource, LidarSweep, LogError, ObjectTrack

__all__ = ["DrivingLog", "FrameSource", "LidarSweep", "LogError", "ObjectTrack"]
