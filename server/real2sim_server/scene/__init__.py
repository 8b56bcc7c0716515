"""The world as data: Gaussians, objects with trajectories, sky, cameras.

Knows neither the passing of time nor HTTP.
"""

from .asset import Asset
from .camera import Camera, CameraRig
from .cloud import GaussianCloud
from .colour import TimeColour
from .errors import (
    BundleError,
    BundleTooLargeError,
    SceneError,
    TimeOutOfRangeError,
    UnknownObjectError,
)
from .ground import Ground
from .scene import Scene, SceneObject
from .sky import Sky
from .trajectory import Trajectory

__all__ = [
    "Asset",
    "BundleError",
    "BundleTooLargeError",
    "Camera",
    "CameraRig",
    "GaussianCloud",
    "Ground",
    "Scene",
    "SceneError",
    "SceneObject",
    "Sky",
    "TimeColour",
    "TimeOutOfRangeError",
    "Trajectory",
    "UnknownObjectError",
]
