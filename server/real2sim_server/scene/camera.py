"""Cameras and the rig that carries them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import Float
from ..geometry.transform import invert_transform, is_rigid
from .errors import SceneError

T_VEHICLE_OPTICAL = np.array(
    [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64
)
"""Rotation from an OpenCV camera frame that looks along vehicle x (x right, y down, z forward)."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated pinhole camera on the vehicle, free of distortion.

    Attributes:
        name: unique on its rig.
        width, height: image size [px].
        K: [3, 3] float64, intrinsics [px]; pixel centres lie at +0.5.
        T_vehicle_camera: [4, 4] float64; camera frame is OpenCV (x right, y down, z forward).

    Raises:
        SceneError: for sizes below 1, a K without positive focal lengths, or a pose that is no
            rigid transform.
    """

    name: str
    width: int
    height: int
    K: NDArray[np.float64]
    T_vehicle_camera: Float

    def __post_init__(self) -> None:
        k = np.array(self.K, dtype=np.float64)
        pose = np.array(self.T_vehicle_camera, dtype=np.float64)
        if self.width < 1 or self.height < 1:
            raise SceneError(
                f"camera {self.name!r}: size {self.width}x{self.height} is not positive"
            )
        if k.shape != (3, 3) or not np.isfinite(k).all() or k[0, 0] <= 0 or k[1, 1] <= 0:
            raise SceneError(
                f"camera {self.name!r}: K must be 3x3 with positive focal lengths, not {k.tolist()}"
            )
        if not is_rigid(pose):
            raise SceneError(f"camera {self.name!r}: T_vehicle_camera is not a rigid transform")
        object.__setattr__(self, "K", k)
        object.__setattr__(self, "T_vehicle_camera", pose)

    def resized(self, width: int) -> Camera:
        """The same camera at another image width [px]; the height follows the aspect ratio."""
        if width == self.width:
            return self
        height = max(1, round(self.height * width / self.width))
        k = self.K.copy()
        k[0] *= width / self.width
        k[1] *= height / self.height
        return replace(self, width=width, height=height, K=k)

    def viewmat(self, T_world_vehicle: Float) -> Float:
        """``T_camera_world`` [4, 4] when the vehicle stands at ``T_world_vehicle``."""
        return invert_transform(self.pose(T_world_vehicle))

    def pose(self, T_world_vehicle: Float) -> Float:
        """``T_world_camera`` [4, 4] when the vehicle stands at ``T_world_vehicle``."""
        return T_world_vehicle @ self.T_vehicle_camera


@dataclass(frozen=True, eq=False)
class CameraRig:
    """The cameras of a vehicle, by name and in order."""

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        names = [c.name for c in self.cameras]
        if len(set(names)) != len(names):
            raise SceneError(f"camera names must be unique, not {names}")

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def names(self) -> tuple[str, ...]:
        """Camera names in order."""
        return tuple(c.name for c in self.cameras)

    def __getitem__(self, name: str) -> Camera:
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise SceneError(f"unknown camera {name!r}; this rig has {list(self.names)}")
