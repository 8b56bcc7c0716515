"""Finds and tracks moving objects in LiDAR, for logs without boxes."""

from .track import TrackingOptions, track_moving_objects

__all__ = ["TrackingOptions", "track_moving_objects"]
