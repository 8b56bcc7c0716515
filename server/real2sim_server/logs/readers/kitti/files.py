"""The text files of the KITTI tracking layout: calibration, poses, labels, time stamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....geometry.rotation import Float
from ....geometry.transform import invert_transform
from ...driving_log import LogError
from ..formats.tables import (
    check_frame_times,
    check_rigid,
    parse_numbers,
    read_lines,
    read_number_table,
)

VELODYNE_HEIGHT = 1.73
"""Height of the Velodyne above the road [m], from the KITTI sensor set-up drawing."""

FRAME_PERIOD_US = 100_000
EARTH_RADIUS = 6378137.0

_KEYS = {
    "rectification": ("R_rect", "R0_rect"),
    "velo_to_cam": ("Tr_velo_cam", "Tr_velo_to_cam"),
    "imu_to_velo": ("Tr_imu_velo", "Tr_imu_to_velo"),
}
_CATEGORIES = {"person": "pedestrian", "person_sitting": "pedestrian", "misc": "other"}


@dataclass(frozen=True, eq=False)
class KittiCalibration:
    """Calibration of one sequence.

    Attributes:
        projections: P0 to P3 [3, 4] by camera index: rectified cam0 coordinates to pixels.
        T_vehicle_velo, T_vehicle_imu: [4, 4] to the vehicle frame (rear axle on the ground).
        T_vehicle_cam0: [4, 4], rectified cam0 to vehicle.
    """

    projections: dict[int, Float]
    T_vehicle_velo: Float
    T_vehicle_imu: Float
    T_vehicle_cam0: Float


@dataclass(frozen=True)
class KittiLabel:
    """One box of one frame, in rectified cam0 coordinates.

    Attributes:
        frame, track_id: as in the file.
        category: lower-case, in the project's words.
        size: (length, width, height) [m].
        T_cam0_object: [4, 4], origin at the box centre, x forward, z up.
    """

    frame: int
    track_id: int
    category: str
    size: tuple[float, float, float]
    T_cam0_object: Float


def read_calibration(path: Path) -> KittiCalibration:
    """Read ``calib/NNNN.txt`` in either spelling of its keys.

    The vehicle frame is placed by the published set-up: the IMU rides over the rear axle, the
    Velodyne on the centre line 1.73 m above the road. Its axes are those of the rectified
    cameras, which were levelled to the road more closely than the Velodyne or the IMU.

    Raises:
        LogError: a matrix is missing, has a wrong number of values, or is no rigid transform.
    """
    return calibration_from(read_entries(path), path)


def calibration_from(entries: Mapping[str, Float], path: Path) -> KittiCalibration:
    """A calibration of its matrices, named as in the tracking set; ``path`` is for errors."""
    rectification = _rigid(path, entries, _KEYS["rectification"])
    T_cam0_velo = rectification @ _rigid(path, entries, _KEYS["velo_to_cam"])
    T_velo_imu = _rigid(path, entries, _KEYS["imu_to_velo"])
    T_vehicle_velo = _place_velodyne(T_cam0_velo, T_velo_imu)
    projections = {
        i: entries[f"P{i}"].reshape(3, 4)
        for i in range(4)
        if f"P{i}" in entries and entries[f"P{i}"].size == 12
    }
    return KittiCalibration(
        projections=projections,
        T_vehicle_velo=T_vehicle_velo,
        T_vehicle_imu=T_vehicle_velo @ T_velo_imu,
        T_vehicle_cam0=T_vehicle_velo @ invert_transform(T_cam0_velo),
    )


def read_entries(path: Path, *, words: Sequence[str] = ()) -> dict[str, Float]:
    """Lines ``key: numbers`` of a calibration file; ``words`` are keys of text, left out.

    Raises:
        LogError: with the line, for values that are no finite numbers.
    """
    entries = {}
    for number, line in enumerate(read_lines(path), start=1):
        key, _, values = line.replace(":", " ").strip().partition(" ")
        if key and key not in words:
            entries[key] = parse_numbers(values.split(), f"{path} line {number}")
    return entries


def _rigid(path: Path, entries: Mapping[str, Float], keys: tuple[str, ...]) -> Float:
    key = next((key for key in keys if key in entries), None)
    if key is None:
        raise LogError(f"{path}: has no line {' or '.join(f'{k}:' for k in keys)}")
    values = entries[key]
    if values.size not in (9, 12):
        raise LogError(f"{path}: {key} must hold 3x3 or 3x4 values, not {values.size}")
    matrix = np.eye(4)
    matrix[:3, : values.size // 3] = values.reshape(3, -1)
    return check_rigid(matrix, f"{path}: {key}")


def _place_velodyne(T_cam0_velo: Float, T_velo_imu: Float) -> Float:
    T_vehicle_velo = np.eye(4)
    T_vehicle_velo[:3, :3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ T_cam0_velo[:3, :3]
    T_vehicle_velo[0, 3] = -(T_vehicle_velo[:3, :3] @ T_velo_imu[:3, 3])[0]
    T_vehicle_velo[2, 3] = VELODYNE_HEIGHT
    return T_vehicle_velo


def read_poses(path: Path) -> Float:
    """``T_world_cam0`` [N, 4, 4] of a KITTI odometry pose file (12 numbers a line).

    Raises:
        LogError: with the line.
    """
    rows = read_number_table(path, columns=12, what="a 3x4 pose, row by row")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    for number, pose in enumerate(poses, start=1):
        check_rigid(pose, f"{path} line {number}")
    return poses


def read_oxts(path: Path) -> Float:
    """``T_world_imu`` [N, 4, 4] of an OXTS file (30 numbers a line), Mercator projection.

    As the KITTI development kit does: the projection is scaled by the cosine of the first
    latitude, and the rotation is Rz(yaw) Ry(pitch) Rx(roll).

    Raises:
        LogError: with the line.
    """
    return oxts_poses(read_number_table(path, columns=30, what="an OXTS record"))


def oxts_poses(rows: Float) -> Float:
    """``T_world_imu`` [N, 4, 4] of OXTS records [N, 30], see :func:`read_oxts`."""
    latitude, longitude, altitude, roll, pitch, yaw = rows[:, :6].T
    scale = np.cos(np.radians(latitude[0]))
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, 0, 3] = scale * EARTH_RADIUS * np.radians(longitude)
    poses[:, 1, 3] = scale * EARTH_RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    poses[:, 2, 3] = altitude
    poses[:, :3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    return poses


def _about(axis: int, angle: Float) -> Float:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.tile(np.eye(3), (len(angle), 1, 1))
    rotation[:, i, i] = rotation[:, j, j] = np.cos(angle)
    rotation[:, i, j], rotation[:, j, i] = -np.sin(angle), np.sin(angle)
    return rotation


def read_times(path: Path, frame_count: int) -> NDArray[np.int64]:
    """Frame times [F] [us]: seconds, one a line, from ``path``, or 10 Hz where it is absent.

    Raises:
        LogError: wrong count or order.
    """
    if not path.exists():
        return np.arange(frame_count, dtype=np.int64) * FRAME_PERIOD_US
    seconds = read_number_table(path, columns=1, what="seconds")[:, 0]
    if len(seconds) != frame_count:
        raise LogError(f"{path}: holds {len(seconds)} times, but there are {frame_count} frames")
    return check_frame_times(np.round(seconds * 1e6).astype(np.int64), str(path))


def read_labels(path: Path, frame_count: int) -> list[KittiLabel]:
    """All boxes of a tracking label file (17 columns), without ``DontCare`` regions.

    Raises:
        LogError: with the line, for wrong columns, frames outside the log, or sizes of zero.
    """
    labels = []
    for number, line in enumerate(read_lines(path), start=1):
        words = line.split()
        where = f"{path} line {number}"
        if len(words) != 17:
            raise LogError(
                f"{where}: expected 17 columns (frame id type truncated occluded alpha, 2D box, "
                f"h w l, x y z, ry), found {len(words)}"
            )
        if words[2] != "DontCare":
            labels.append(_parse_label(words, where, frame_count))
    return labels


def _parse_label(words: list[str], where: str, frame_count: int) -> KittiLabel:
    numbers = parse_numbers(words[:2] + words[10:], where)
    frame, track_id = int(numbers[0]), int(numbers[1])
    height, width, length, x, y, z, heading = numbers[2:]
    if not 0 <= frame < frame_count:
        raise LogError(f"{where}: frame {frame} is outside the log's 0 to {frame_count - 1}")
    if min(height, width, length) <= 0:
        raise LogError(f"{where}: box sizes must be positive, not {height} {width} {length}")
    kind = words[2].lower()
    cos, sin = np.cos(heading), np.sin(heading)
    pose = np.eye(4)
    # Columns: forward, left, up of the object in camera axes (x right, y down, z forward).
    pose[:3, :3] = np.array([[cos, sin, 0], [0, 0, -1], [-sin, cos, 0]])
    pose[:3, 3] = x, y - height / 2, z
    category = _CATEGORIES.get(kind, kind)
    return KittiLabel(frame, track_id, category, (length, width, height), pose)
