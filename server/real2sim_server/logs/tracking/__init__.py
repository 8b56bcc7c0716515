"""Finds and tracks moving objects in LiDAR, for logs without boxes."""

from .track import TrackingOptions, merge_tracks, track_moving_objects

__all__ = ["TrackingOptions", "merge_tracks", "track_moving_objects"]
