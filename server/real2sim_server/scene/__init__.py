"""Scene data: Gaussians, objects with trajectories, sky, cameras.

This package is independent of simulation time and of HTTP.
"""

from .asset import Asset
from .camera import Camera, CameraMotion, CameraRig, Shutter
from .cloud import UNSEEN, GaussianCloud, TimeColour
from .coverage import Coverage
from .errors import (
    BundleError,
    BundleTooLargeError,
    LidarError,
    RadarError,
    SceneError,
    TimeOutOfRangeError,
    UnknownObjectError,
)
from .figure import Figure, Stride
from .ground import Ground
from .lane import Area, Lane, LanePlace, Road, RoadLane, Signal, StopLine
from .lane_graph import LaneGraph
from .lens import BrownConrady, Fisheye, FTheta, Lens, Omnidirectional
from .lidar_surfaces import LidarSurfaces, Reflector, RingResponse
from .range_sensors import Beams, Detection, Lidar, Radar
from .scene import Scene, SceneObject, Sky
from .sunlight import Sunlight
from .trajectory import Trajectory

__all__ = [
    "UNSEEN",
    "Area",
    "Asset",
    "Beams",
    "BrownConrady",
    "BundleError",
    "BundleTooLargeError",
    "Camera",
    "CameraMotion",
    "CameraRig",
    "Coverage",
    "Detection",
    "FTheta",
    "Figure",
    "Fisheye",
    "GaussianCloud",
    "Ground",
    "Lane",
    "LaneGraph",
    "LanePlace",
    "Lens",
    "Lidar",
    "LidarError",
    "LidarSurfaces",
    "Omnidirectional",
    "Radar",
    "RadarError",
    "Reflector",
    "RingResponse",
    "Road",
    "RoadLane",
    "Scene",
    "SceneError",
    "SceneObject",
    "Shutter",
    "Signal",
    "Sky",
    "StopLine",
    "Stride",
    "Sunlight",
    "TimeColour",
    "TimeOutOfRangeError",
    "Trajectory",
    "UnknownObjectError",
]
