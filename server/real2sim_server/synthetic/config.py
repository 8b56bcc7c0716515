"""What a synthetic drive shall be like."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.transform import transform_from, yaw_quaternion
from ..scene import Camera, CameraRig
from ..scene.camera import T_VEHICLE_OPTICAL


@dataclass(frozen=True)
class CameraSpec:
    """A camera of the rig.

    Attributes:
        name: unique on the rig.
        yaw: viewing direction about the vehicle's z axis [rad], 0 = ahead, positive = left.
        fov: horizontal field of view [rad].
        position: in the vehicle frame [m].
    """

    name: str
    yaw: float = 0.0
    fov: float = math.radians(70)
    position: tuple[float, float, float] = (1.7, 0.0, 1.6)


DEFAULT_CAMERAS = (
    CameraSpec("front"),
    CameraSpec("front_left", yaw=math.radians(50), position=(1.6, 0.25, 1.6)),
    CameraSpec("front_right", yaw=math.radians(-50), position=(1.6, -0.25, 1.6)),
)


@dataclass(frozen=True)
class SyntheticConfig:
    """A synthetic drive; the same values give the same bits.

    Attributes:
        seed: of everything random: street, traffic, textures, LiDAR noise.
        frames: number of frames.
        hz: frames per second, and turns of the LiDAR per second.
        width, height: image size of every camera [px].
        cameras: the rig.
        samples: rays per pixel along each image axis, where there are edges.
        moving_cars: vehicles that drive, ahead of the ego vehicle and towards it.
        parked_cars: vehicles at the kerbs; fewer where the street has no room for more.
        speed: mean speed of the ego vehicle [m/s].
        lidar_beams, lidar_columns: beams, and azimuth steps per turn; 0 beams for no LiDAR.
        lidar_range: farthest return [m].
        lidar_noise: standard deviation of the measured range [m].
        pedestrians, cyclists: who walk, wait, cross and run, and who ride; a street with them has
            the vehicles of the one without.

    Raises:
        ValueError: a value that gives no drive.
    """

    seed: int = 0
    frames: int = 60
    hz: float = 10.0
    width: int = 480
    height: int = 320
    cameras: tuple[CameraSpec, ...] = DEFAULT_CAMERAS
    samples: int = 2
    moving_cars: int = 4
    parked_cars: int = 14
    speed: float = 8.0
    lidar_beams: int = 64
    lidar_columns: int = 1024
    lidar_range: float = 80.0
    lidar_noise: float = 0.02
    pedestrians: int = 0
    cyclists: int = 0

    def __post_init__(self) -> None:
        least = {
            "seed": 0,
            "frames": 1,
            "width": 1,
            "height": 1,
            "samples": 1,
            "moving_cars": 0,
            "parked_cars": 0,
            "lidar_beams": 0,
            "lidar_columns": 1,
            "lidar_noise": 0,
            "pedestrians": 0,
            "cyclists": 0,
        }
        for name, bound in least.items():
            if not getattr(self, name) >= bound:
                raise ValueError(f"{name} must be at least {bound}, not {getattr(self, name)!r}")
        for name, bound, limit in (("hz", 0, 1000), ("speed", 0, 40), ("lidar_range", 0, 1000)):
            if not bound < getattr(self, name) <= limit:
                raise ValueError(
                    f"{name} must be above {bound} and at most {limit}, not {getattr(self, name)!r}"
                )
        if not self.cameras:
            raise ValueError("cameras must name at least one camera")
        for camera in self.cameras:
            if not 0 < camera.fov < math.pi:
                raise ValueError(f"fov of {camera.name!r} must be in (0, pi), not {camera.fov!r}")

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> SyntheticConfig:
        """From the JSON values of ``dataclasses.asdict``, as a log's provenance holds them.

        Raises:
            KeyError, TypeError, ValueError: values of another version of this class.
        """
        cameras = tuple(
            CameraSpec(**{**camera, "position": tuple(camera["position"])})
            for camera in values["cameras"]
        )
        return cls(**{**values, "cameras": cameras})

    @property
    def frame_period_us(self) -> int:
        """Time between frames [us]."""
        return round(1e6 / self.hz)

    @property
    def duration(self) -> float:
        """Time from the first to the last frame [s]."""
        return (self.frames - 1) * self.frame_period_us * 1e-6

    def rig(self) -> CameraRig:
        """The calibrated cameras."""
        return CameraRig(tuple(self._camera(spec) for spec in self.cameras))

    def _camera(self, spec: CameraSpec) -> Camera:
        focal = self.width / (2 * math.tan(spec.fov / 2))
        k = np.array([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1]])
        pose = transform_from(spec.position, yaw_quaternion(spec.yaw)) @ T_VEHICLE_OPTICAL
        return Camera(spec.name, self.width, self.height, k, pose)
