"""Waymo v1 TFRecord, encoded field by field, without beam angles and pixel poses."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from real2sim_server.geometry import (
    invert_transform,
    matrix_to_quaternion,
    quaternion_yaw,
)
from real2sim_server.logs import DrivingLog
from real2sim_server.logs.images import encode_image
from real2sim_server.logs.readers.waymo_v1 import masked_crc32c
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

BEAMS, COLUMNS = 100, 2048
LOW, HIGH = np.radians(-45.0), np.radians(5.0)
NUMBERS = {"front": 1, "front_left": 2, "front_right": 3}
FAR_AWAY = np.array([-25211.2589, 42391.0813, -160.618])


def write(log: DrivingLog, path: Path) -> None:
    write_payloads([_frame(log, frame) for frame in range(log.frame_count)], path)


def write_payloads(payloads: list[bytes], path: Path) -> None:
    with path.open("wb") as file:
        for payload in payloads:
            length = struct.pack("<Q", len(payload))
            file.write(length + struct.pack("<I", masked_crc32c(length)))
            file.write(payload + struct.pack("<I", masked_crc32c(payload)))


def _frame(log: DrivingLog, frame: int) -> bytes:
    t_us = int(log.frame_times_us[frame])
    start_us = t_us - 50_000
    pose = _waymo_pose(log, t_us)
    parts = [_blob(1, _context(log)), _varint_field(2, start_us), _blob(3, _transform(pose))]
    parts += [_blob(4, _image(log, frame, name)) for name in log.rig.names]
    parts += [_blob(5, _laser(log, frame))]
    parts += [_blob(6, label) for label in _labels(log, t_us)]
    return b"".join(parts)


def _waymo_pose(log: DrivingLog, t_us: int) -> np.ndarray:
    pose = log.ego.transform(t_us)
    pose[:3, 3] += FAR_AWAY
    return pose


def _context(log: DrivingLog) -> bytes:
    parts = [_blob(1, b"tiny_0_20")]
    optical = np.linalg.inv(T_VEHICLE_OPTICAL)
    for camera in log.rig:
        k = camera.K
        intrinsic = (k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0, 0, 0, 0)
        parts.append(
            _blob(
                2,
                _varint_field(1, NUMBERS[camera.name])
                + b"".join(_double(2, v) for v in intrinsic)
                + _blob(3, _transform(camera.T_vehicle_camera @ optical))
                + _varint_field(4, camera.width)
                + _varint_field(5, camera.height)
                + _varint_field(6, 2),
            )
        )
    laser = _varint_field(1, 1) + _double(3, LOW) + _double(4, HIGH)
    return b"".join([*parts, _blob(3, laser + _blob(5, _transform(_laser_pose(log))))])


def _laser_pose(log: DrivingLog) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = log.lidar(0).origin
    return pose


def _image(log: DrivingLog, frame: int, name: str) -> bytes:
    t_us = log.image_time_us(name, frame)
    seconds = t_us * 1e-6
    return (
        _varint_field(1, NUMBERS[name])
        + _blob(2, encode_image(log.image(name, frame), ".png"))
        + _blob(3, _transform(_waymo_pose(log, t_us)))
        + _double(5, seconds)
        + _double(6, 0.01)
        + _double(7, seconds - 0.025)
        + _double(8, seconds + 0.025)
    )


def _laser(log: DrivingLog, frame: int) -> bytes:
    sweep = log.lidar(frame)
    x, y, z = (sweep.points.astype(np.float64) - sweep.origin).T
    fraction = (np.arctan2(z, np.hypot(x, y)) - LOW) / (HIGH - LOW)
    row = BEAMS - 1 - np.clip((fraction * BEAMS).astype(int), 0, BEAMS - 1)
    column = ((np.pi - np.arctan2(y, x)) / (2 * np.pi) * COLUMNS).astype(int) % COLUMNS
    values = np.zeros((BEAMS, COLUMNS, 4), np.float32)
    values[row, column, 0] = np.sqrt(x * x + y * y + z * z)
    values[row, column, 1] = sweep.intensity
    shape = b"".join(_varint_field(1, n) for n in values.shape)
    matrix = _blob(1, values.tobytes()) + _blob(2, shape)
    return _varint_field(1, 1) + _blob(2, _blob(2, zlib.compress(matrix)))


def _labels(log: DrivingLog, t_us: int) -> list[bytes]:
    labels = []
    to_vehicle = invert_transform(log.ego.transform(t_us))
    for track in log.tracks:
        pose = to_vehicle @ track.trajectory.transform(t_us)
        heading = float(quaternion_yaw(matrix_to_quaternion(pose[:3, :3])))
        length, width, height = track.size
        box = (*pose[:3, 3], width, length, height, heading)
        encoded = b"".join(_double(i, v) for i, v in enumerate(box, start=1))
        labels.append(_blob(1, encoded) + _varint_field(3, 1) + _blob(4, track.object_id.encode()))
    return labels


def _transform(matrix: np.ndarray) -> bytes:
    return b"".join(_double(1, v) for v in matrix.ravel())


def _varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    encoded = b""
    while value > 0x7F:
        encoded += bytes([value & 0x7F | 0x80])
        value >>= 7
    return encoded + bytes([value])


def _varint_field(number: int, value: int) -> bytes:
    return _varint(number << 3) + _varint(value)


def _double(number: int, value: float) -> bytes:
    return _varint(number << 3 | 1) + struct.pack("<d", value)


def _blob(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(data)) + data
