"""Sensors of a data set from a file: cameras of the scene or of one's own, and a LiDAR."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..geometry.transform import transform_from
from ..scene import Camera, CameraRig, SceneError
from ..scene.camera import T_VEHICLE_OPTICAL
from .errors import DatasetError

Degrees = Annotated[float, Field(ge=-360, le=360)]


class RigCamera(BaseModel):
    """A camera of a rig file: one of the scene by its name, or one of its own where ``hfov_deg``
    is given, which looks along the vehicle's x axis where nothing turns it."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,79}$")]
    width: Annotated[int, Field(ge=16, le=8192)] | None = None
    height: Annotated[int, Field(ge=16, le=8192)] | None = None
    hfov_deg: Annotated[float, Field(gt=1, lt=170)] | None = None
    position: tuple[float, float, float] = (1.5, 0.0, 1.5)
    yaw_deg: Degrees = 0.0
    pitch_deg: Degrees = 0.0
    roll_deg: Degrees = 0.0


class Rig(BaseModel):
    """A rig file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    cameras: Annotated[list[RigCamera], Field(min_length=1, max_length=64)]
    lidar: str | dict[str, Any] | None = None


def read_rig(path: Path) -> dict[str, Any]:
    """The values of a rig file. Raises DatasetError for what is none."""
    try:
        values = json.loads(path.read_bytes())
        Rig.model_validate(values)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: is no rig file ({error})") from error
    return dict(values)


def cameras_of(values: Mapping[str, Any], rig: CameraRig) -> list[Camera]:
    """The cameras that a rig file names, in its order.

    Raises:
        DatasetError: values that are no rig, a camera that the scene lacks, or the same name twice.
    """
    try:
        asked = Rig.model_validate(values).cameras
    except ValidationError as error:
        raise DatasetError(f"rig: {error}") from error
    names = [camera.name for camera in asked]
    if len(set(names)) != len(names):
        raise DatasetError(f"rig: a camera's name stands for one camera only, not {names}")
    return [_camera(camera, rig) for camera in asked]


def _camera(asked: RigCamera, rig: CameraRig) -> Camera:
    if asked.hfov_deg is None:
        if asked.name not in rig.names:
            known = ", ".join(rig.names) or "none"
            raise DatasetError(
                f"rig: camera {asked.name!r}; the scene has {known}; give hfov_deg, width and "
                "height for one of your own"
            )
        camera = rig[asked.name]
        return camera if asked.width is None else camera.resized(asked.width)
    if asked.width is None or asked.height is None:
        raise DatasetError(f"rig: camera {asked.name!r} with hfov_deg wants width and height")
    focal = asked.width / (2 * math.tan(math.radians(asked.hfov_deg) / 2))
    K = np.array([[focal, 0, asked.width / 2], [0, focal, asked.height / 2], [0, 0, 1.0]])
    pose = transform_from(asked.position, (1.0, 0.0, 0.0, 0.0))
    pose[:3, :3] = _turn(asked) @ T_VEHICLE_OPTICAL[:3, :3]
    try:
        return Camera(asked.name, asked.width, asked.height, K, pose)
    except SceneError as error:
        raise DatasetError(f"rig: {error}") from error


def _turn(asked: RigCamera) -> Any:
    """Yaw to the left, then pitch upwards, then roll to the right, about the camera's own axes."""
    yaw, pitch, roll = (math.radians(a) for a in (asked.yaw_deg, asked.pitch_deg, asked.roll_deg))
    about_z = [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
    about_y = [
        [math.cos(pitch), 0, -math.sin(pitch)],
        [0, 1, 0],
        [math.sin(pitch), 0, math.cos(pitch)],
    ]
    about_x = [[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]
    return np.array(about_z) @ np.array(about_y) @ np.array(about_x)
