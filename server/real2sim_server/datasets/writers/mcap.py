"""MCAP: one file per clip with images, points, boxes and poses, for Foxglove, Rerun and others.

Source: the MCAP specification 1.0 and Foxglove's schemas in JSON. Needs the ``mcap`` extra.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...geometry import Float, matrix_to_quaternion
from ...render import encode_image
from ...scene import Camera
from ...world.mcap_file import json_channel, stamp_of
from ..clips import Clip
from ..drive import DatasetError
from .writer import LabelledDrive, objects_of

QUALITY = 95
EGO, WORLD = "ego", "world"
FLOAT32, UINT8, UINT16, INT32 = 7, 1, 3, 6
"""Numeric types of ``foxglove.PackedElementField``."""

FIELDS = (
    ("x", "<f4", FLOAT32),
    ("y", "<f4", FLOAT32),
    ("z", "<f4", FLOAT32),
    ("intensity", "<f4", FLOAT32),
    ("instance", "<u2", UINT16),
    ("semantic", "u1", UINT8),
    ("beam", "u1", UINT8),
    ("time_us", "<i4", INT32),
)

Message = tuple[str, str, dict[str, Any]]
"""Topic, schema and content."""


class McapWriter:
    """Writes ``<clip>.mcap``."""

    name = "mcap"
    holds = "a file a clip: /tf, /boxes, /lidar, /camera/<name>, its calibration and instances"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError; DatasetError without the ``mcap`` extra."""
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise DatasetError(
                "the format 'mcap' needs the mcap extra: pip install 'real2sim[mcap]'"
            ) from error
        for clip in drive.clips:
            with (folder / f"{clip.name}.mcap").open("wb") as file:
                writer: Any = Writer(file)
                writer.start(profile="", library="real2sim")
                self._write_clip(writer, drive, clip)
                fields = {"scene": drive.name, "split": clip.split, "licence": drive.licence}
                writer.add_metadata("real2sim", fields)
                writer.finish()

    def _write_clip(self, writer: Any, drive: LabelledDrive, clip: Clip) -> None:
        channels: dict[str, int] = {}
        for frame in clip.frames:
            time_ns = frame["t_us"] * 1000
            for topic, schema, message in _messages(drive, clip, frame):
                if topic not in channels:
                    channels[topic] = json_channel(writer, topic, schema, message)
                body = json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
                writer.add_message(channels[topic], time_ns, body, time_ns)


def _messages(drive: LabelledDrive, clip: Clip, frame: Mapping[str, Any]) -> Iterator[Message]:
    stamp = stamp_of(frame["t_us"])
    yield "/tf", "foxglove.FrameTransform", _transform(frame["T_world_ego"], WORLD, EGO, stamp)
    yield "/boxes", "foxglove.SceneUpdate", _boxes(frame, stamp)
    yield "/lidar", "foxglove.PointCloud", _points(clip, frame["index"], stamp)
    for camera in drive.cameras:
        yield from _camera(clip, camera, frame, stamp)


def _camera(
    clip: Clip, camera: Camera, frame: Mapping[str, Any], stamp: dict[str, int]
) -> Iterator[Message]:
    name, index = camera.name, frame["index"]
    mount = _transform(camera.T_vehicle_camera.tolist(), EGO, name, stamp)
    yield "/tf", "foxglove.FrameTransform", mount
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    calibration = {
        "timestamp": stamp,
        "frame_id": name,
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "",
        "D": [],
        "K": K.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": np.concatenate([K, np.zeros((3, 1))], axis=1).ravel().tolist(),
    }
    yield f"/camera/{name}/calibration", "foxglove.CameraCalibration", calibration
    rgb = clip.pixels("rgb", name, index)
    jpeg = encode_image(rgb, "rgb", "jpeg", quality=QUALITY).data
    yield f"/camera/{name}", "foxglove.CompressedImage", _image(name, "jpeg", jpeg, stamp)
    instance = clip.file("instance", name, index).read_bytes()
    image = _image(name, "png", instance, stamp)
    yield f"/camera/{name}/instance", "foxglove.CompressedImage", image
    boxes = {"timestamp": stamp, "frame_id": name, "boxes": _views(frame, name)}
    yield f"/camera/{name}/boxes", "real2sim.Boxes2D", boxes


def _views(frame: Mapping[str, Any], camera: str) -> list[dict[str, Any]]:
    objects = objects_of(frame)
    kept = ("object_id", "box_2d_modal", "box_2d_amodal", "visibility", "truncation")
    return [
        {"category": objects[view["object_id"]]["category"], **{k: view[k] for k in kept}}
        for view in frame["views"][camera]
    ]


def _transform(
    pose: list[list[float]], parent: str, child: str, stamp: dict[str, int]
) -> dict[str, Any]:
    placed = _pose(np.array(pose))
    return {
        "timestamp": stamp,
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": placed["position"],
        "rotation": placed["orientation"],
    }


def _boxes(frame: Mapping[str, Any], stamp: dict[str, int]) -> dict[str, Any]:
    entities = [
        {
            "timestamp": stamp,
            "frame_id": WORLD,
            "id": subject["object_id"],
            "lifetime": {"sec": 0, "nsec": 0},
            "frame_locked": False,
            "metadata": [
                {"key": "category", "value": subject["category"]},
                {"key": "points", "value": str(subject["points"])},
            ],
            "cubes": [
                {
                    "pose": _pose(np.array(subject["T_world_object"])),
                    "size": dict(zip("xyz", subject["size"], strict=True)),
                    "color": {"r": 1.0, "g": 0.55, "b": 0.25, "a": 0.5},
                }
            ],
        }
        for subject in frame["objects"]
    ]
    return {"deletions": [], "entities": entities}


def _points(clip: Clip, frame: int, stamp: dict[str, int]) -> dict[str, Any]:
    rows = clip.points(frame)
    packed = np.zeros(len(rows), [(name, kind) for name, kind, _ in FIELDS])
    for k, axis in enumerate("xyz"):
        packed[axis] = rows["xyz"][:, k]
    for name, _, _ in FIELDS[3:]:
        packed[name] = rows[name]
    fields = packed.dtype.fields
    assert fields is not None
    return {
        "timestamp": stamp,
        "frame_id": EGO,
        "pose": _pose(np.eye(4)),
        "point_stride": packed.dtype.itemsize,
        "fields": [
            {"name": name, "offset": fields[name][1], "type": number} for name, _, number in FIELDS
        ],
        "data": base64.b64encode(packed.tobytes()).decode(),
    }


def _image(frame_id: str, kind: str, data: bytes, stamp: dict[str, int]) -> dict[str, Any]:
    return {
        "timestamp": stamp,
        "frame_id": frame_id,
        "data": base64.b64encode(data).decode(),
        "format": kind,
    }


def _pose(transform: Float) -> dict[str, Any]:
    w, x, y, z = matrix_to_quaternion(transform[:3, :3]).tolist()
    position = dict(zip("xyz", transform[:3, 3].tolist(), strict=True))
    return {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}
