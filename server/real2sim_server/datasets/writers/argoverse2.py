"""Argoverse 2, sensor data set: one log per clip.

Source: the user guide and ``av2`` package of the data set (Wilson et al. 2021). The ego frame is on
the rear axle, 0.33 m above the ground; pixel centres are at integers; boxes are in the ego frame at
their time.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import feather

from ...geometry import Float, matrix_to_quaternion
from ...logs.readers.argoverse2 import AXLE_HEIGHT
from ...render import encode_image
from ...scene import Camera
from ..clips import Clip
from ..labels.points import points_in_boxes
from .categories import classes_of
from .nuscenes import FRONT, channels_of
from .writer import LabelledDrive

QUATERNION, POSITION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
SIZE = ("length_m", "width_m", "height_m")
QUALITY = 95


class Argoverse2Writer:
    """Writes ``<split>/<log>`` with poses, calibration, annotations, sweeps and images."""

    name = "argoverse2"
    holds = "logs with poses, calibration, annotations (points inside counted), lidar, images"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        names = ring_names(drive.cameras)
        for clip in drive.clips:
            log = folder / clip.split / str(uuid.UUID(drive.token("log", clip.name)))
            _write_calibration(log / "calibration", drive, names)
            _write_poses(log / "city_SE3_egovehicle.feather", clip)
            _write_annotations(log / "annotations.feather", drive, clip)
            for frame in clip.frames:
                stamp = f"{frame['t_us'] * 1000}"
                _write_sweep(log / "sensors" / "lidar" / f"{stamp}.feather", clip, frame["index"])
                for camera in drive.cameras:
                    path = log / "sensors" / "cameras" / names[camera.name] / f"{stamp}.jpg"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    rgb = clip.pixels("rgb", camera.name, frame["index"])
                    path.write_bytes(encode_image(rgb, "rgb", "jpeg", quality=QUALITY).data)


def ring_names(cameras: Sequence[Camera]) -> dict[str, str]:
    """``ring_front_center`` for the camera that looks ahead most, ``ring_<name>`` for others."""
    return {
        name: "ring_front_center" if channel == FRONT else f"ring_{name.removeprefix('ring_')}"
        for name, channel in channels_of(cameras).items()
    }


def _write_calibration(folder: Path, drive: LabelledDrive, names: Mapping[str, str]) -> None:
    cameras = drive.cameras
    mounts = {names[camera.name]: camera.T_vehicle_camera for camera in cameras}
    roof = np.eye(4)
    roof[:3, 3] = drive.lidar_position
    mounts["up_lidar"] = roof
    poses = _shift(-AXLE_HEIGHT) @ np.array(list(mounts.values()))
    columns = {"sensor_name": list(mounts), **_pose_columns(poses)}
    _write(folder / "egovehicle_SE3_sensor.feather", columns)
    intrinsics: dict[str, Any] = {
        "sensor_name": [names[camera.name] for camera in cameras],
        "fx_px": [float(camera.K[0, 0]) for camera in cameras],
        "fy_px": [float(camera.K[1, 1]) for camera in cameras],
        "cx_px": [float(camera.K[0, 2]) - 0.5 for camera in cameras],
        "cy_px": [float(camera.K[1, 2]) - 0.5 for camera in cameras],
        **{name: [0.0] * len(cameras) for name in ("k1", "k2", "k3")},
        "height_px": [camera.height for camera in cameras],
        "width_px": [camera.width for camera in cameras],
    }
    _write(folder / "intrinsics.feather", intrinsics)


def _write_poses(path: Path, clip: Clip) -> None:
    stamps = [frame["t_us"] * 1000 for frame in clip.frames]
    poses = np.array([frame["T_world_ego"] for frame in clip.frames]) @ _shift(AXLE_HEIGHT)
    _write(path, {"timestamp_ns": stamps, **_pose_columns(poses)})


def _write_annotations(path: Path, drive: LabelledDrive, clip: Clip) -> None:
    rows = [(frame["t_us"], subject) for frame in clip.frames for subject in frame["objects"]]
    poses = _shift(-AXLE_HEIGHT) @ _poses_of([subject for _, subject in rows])
    tracks = {
        subject["object_id"]: str(uuid.UUID(drive.token("track", clip.name, subject["object_id"])))
        for _, subject in rows
    }
    counts = [count for frame in clip.frames for count in _counts(clip, frame)]
    columns = {
        "timestamp_ns": [t_us * 1000 for t_us, _ in rows],
        "track_uuid": pa.array([tracks[s["object_id"]] for _, s in rows], pa.string()),
        "category": pa.array([_category(s["category"]) for _, s in rows], pa.string()),
        **{name: [float(s["size"][k]) for _, s in rows] for k, name in enumerate(SIZE)},
        **_pose_columns(poses),
        "num_interior_pts": pa.array(counts, pa.int64()),
    }
    _write(path, columns)


def _counts(clip: Clip, frame: Mapping[str, Any]) -> list[int]:
    """Number of points in each box of a frame, counted in the rounded points of the sweep."""
    subjects = frame["objects"]
    poses = _shift(-AXLE_HEIGHT) @ _poses_of(subjects)
    return points_in_boxes(_xyz(clip, frame["index"]), poses, [s["size"] for s in subjects])


def _poses_of(subjects: Sequence[Mapping[str, Any]]) -> Float:
    return np.array([subject["T_ego_object"] for subject in subjects]).reshape(-1, 4, 4)


def _xyz(clip: Clip, frame: int) -> NDArray[np.float32]:
    """Points [N, 3] of a sweep in the frame of the rear axle [m]."""
    points = clip.points(frame)["xyz"].astype(np.float64)
    points[:, 2] -= AXLE_HEIGHT
    return points.astype(np.float32)


def _write_sweep(path: Path, clip: Clip, frame: int) -> None:
    rows, points = clip.points(frame), _xyz(clip, frame)
    columns: dict[str, Any] = {name: points[:, k].copy() for k, name in enumerate("xyz")}
    columns["intensity"] = np.rint(rows["intensity"] * 255).astype(np.uint8)
    columns["laser_number"] = rows["beam"].copy()
    columns["offset_ns"] = rows["time_us"] * np.int32(1000)
    _write(path, columns)


def _category(category: str) -> str:
    return classes_of(category).argoverse2 or category.upper()


def _pose_columns(poses: Float) -> dict[str, Any]:
    quaternions = matrix_to_quaternion(poses[:, :3, :3])
    columns = {name: quaternions[:, k].copy() for k, name in enumerate(QUATERNION)}
    return columns | {name: poses[:, k, 3].copy() for k, name in enumerate(POSITION)}


def _shift(z: float) -> Float:
    """Shift of the ego frame along its z axis."""
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def _write(path: Path, columns: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(dict(columns)), path, compression="zstd")
