"""LiDAR surfaces of a scene: Gaussians learned from the recorded sweeps."""

from .rays import RecordedRays, recorded_rays
from .surfaces import STEPS, SurfacesReport, fit_lidar_surfaces, has_sweeps

__all__ = [
    "STEPS",
    "RecordedRays",
    "SurfacesReport",
    "fit_lidar_surfaces",
    "has_sweeps",
    "recorded_rays",
]
