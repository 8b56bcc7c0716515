"""LiDAR surfaces of a scene: Gaussians learned from the recorded sweeps."""

from .rays import RecordedRays, recorded_rays
from .surfaces import SurfacesReport, fit_lidar_surfaces

__all__ = ["RecordedRays", "SurfacesReport", "fit_lidar_surfaces", "recorded_rays"]
