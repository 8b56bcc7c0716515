"""The world as data: Gaussians, objects with trajectories, sky, cameras.

Knows neither the passing of time nor HTTP.
"""

from .asset import Asset
from .camera import Camera, CameraRig
from .camera_motion import CameraMotion
from .cloud import UNSEEN, GaussianCloud
from .colour import TimeColour
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
from .lane import Area, Lane, LanePlace, Signal, StopLine
from .lane_graph import LaneGraph
from .lens import BrownConrady, Fisheye, FTheta, Lens, Omnidirectional
from .lidar import Beams, Detection, Lidar
from .lidar_surfaces import LidarSurfaces, Reflector, RingResponse
from .radar import Radar
from .road import Road, RoadLane
from .scene import Scene, SceneObject
from .shutter import Shutter
from .sky import Sky
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
    "TimeColour",
    "TimeOutOfRangeError",
    "Trajectory",
    "UnknownObjectError",
]
