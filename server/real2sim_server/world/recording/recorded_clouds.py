"""Point clouds in recordings, and as Foxglove's messages."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto import CodecError, decode

from ...geometry.rotation import matrix_to_quaternion
from ...geometry.transform import are_rigid
from ..ranging import Cloud
from .recording import RecordingError

SUFFIX = "cloud"
MOST_BYTES = 64 << 20

NUMERIC_TYPES = {"uint8": 1, "int8": 2, "uint16": 3, "int16": 4, "int32": 6, "float32": 7}
"""Of foxglove.PackedElementField."""

AXES = ("x", "y", "z")


def cloud_document(cloud: Cloud) -> dict[str, Any]:
    """What a recording keeps of a cloud, in the order of its columns."""
    return {
        "frame": cloud.frame,
        "compensated": cloud.compensated,
        "duration_us": cloud.duration_us,
        "T_world_sensor": cloud.T_world_sensor,
        "T_vehicle_sensor": cloud.T_vehicle_sensor,
        "columns": [[name, np.ascontiguousarray(c)] for name, c in cloud.columns.items()],
    }


def foxglove_cloud(data: bytes, where: str, stamp: dict[str, int]) -> dict[str, Any]:
    """The foxglove.PointCloud of a kept cloud: points in the frame of the sensor (or vehicle), and
    ``pose``, where that is in the world.

    Args:
        data: as kept.
        where: its file in the recording, for messages.
        stamp: its instant.

    Raises:
        RecordingError: it is no cloud.
    """
    try:
        kept = decode(data, max_bytes=MOST_BYTES)
        pose, columns = _pose(kept), [(str(name), column) for name, column in kept["columns"]]
        fields, table = _packed(columns)
    except (CodecError, KeyError, TypeError, ValueError, IndexError) as error:
        raise RecordingError(f"{where} is no point cloud, or is broken: {error}") from error
    return {
        "timestamp": stamp,
        "frame_id": "world",
        "pose": pose,
        "point_stride": table.dtype.itemsize,
        "fields": fields,
        "data": base64.b64encode(table.tobytes()).decode(),
    }


def _packed(
    columns: list[tuple[str, NDArray[Any]]],
) -> tuple[list[dict[str, Any]], NDArray[Any]]:
    """Fields of foxglove.PointCloud, and a record of each point."""
    parts: list[tuple[str, NDArray[Any]]] = []
    for name, column in columns:
        if column.ndim == 1:
            parts.append((name, column))
        else:
            parts += [(AXES[k], column[:, k]) for k in range(column.shape[1])]
    table = np.zeros(len(parts[0][1]), [(name, part.dtype) for name, part in parts])
    for name, part in parts:
        table[name] = part
    form = table.dtype.fields
    assert form is not None
    fields = [
        {"name": name, "offset": form[name][1], "type": NUMERIC_TYPES[part.dtype.name]}
        for name, part in parts
    ]
    return fields, table


def _pose(kept: dict[str, Any]) -> dict[str, Any]:
    T_world_sensor = np.asarray(kept["T_world_sensor"], dtype=np.float64)
    T_vehicle_sensor = np.asarray(kept["T_vehicle_sensor"], dtype=np.float64)
    if not are_rigid(np.stack([T_world_sensor, T_vehicle_sensor])).all():
        raise ValueError("its poses are no rigid transforms")
    pose = T_world_sensor
    if kept["frame"] == "vehicle":
        pose = T_world_sensor @ np.linalg.inv(T_vehicle_sensor)
    w, x, y, z = matrix_to_quaternion(pose[:3, :3]).tolist()
    return {
        "position": dict(zip(AXES, pose[:3, 3].tolist(), strict=True)),
        "orientation": {"x": x, "y": y, "z": z, "w": w},
    }
