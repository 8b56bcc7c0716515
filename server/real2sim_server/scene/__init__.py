"""The world as data: Gaussians, objects with trajectories, sky, cameras. Knows neither time nor HTTP."""

from .camera import Camera, CameraRig
from .cloud import GaussianCloud
from .errors import SceneError
from .scene import Scene, SceneObject
from .sky import Sky
from .trajectory import Trajectory

__all__ = [
    "Camera",
    "CameraRig",
    "GaussianCloud",
    "Scene",
    "SceneError",
    "SceneObject",
    "Sky",
    "Trajectory",
]
