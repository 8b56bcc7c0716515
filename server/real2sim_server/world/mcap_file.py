"""Export of an episode to an MCAP file, for Foxglove, Rerun and other readers.

Messages are JSON and use Foxglove's well-known schemas where available. The recording itself is
attached; read it back with :func:`recording_in`.

Needs the ``mcap`` extra.
"""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto import CodecError, decode

from .._files import atomic_file
from ..geometry import are_rigid, matrix_to_quaternion
from . import scoring
from .ranging import Cloud
from .recording import Recording, RecordingError, recording_of_bytes, to_bytes
from .scoring import Instant

# --- Point clouds --------------------------------------------------------------------------------

SUFFIX = "cloud"
MAX_CLOUD_BYTES = 64 << 20

NUMERIC_TYPES = {"uint8": 1, "int8": 2, "uint16": 3, "int16": 4, "int32": 6, "float32": 7}
"""Codes of foxglove.PackedElementField."""

AXES = ("x", "y", "z")


def cloud_document(cloud: Cloud) -> dict[str, Any]:
    """Fields of a recorded point cloud, in the order of its columns."""
    return {
        "frame": cloud.frame,
        "compensated": cloud.compensated,
        "duration_us": cloud.duration_us,
        "T_world_sensor": cloud.T_world_sensor,
        "T_vehicle_sensor": cloud.T_vehicle_sensor,
        "columns": [[name, np.ascontiguousarray(c)] for name, c in cloud.columns.items()],
    }


def foxglove_cloud(data: bytes, where: str, stamp: dict[str, int]) -> dict[str, Any]:
    """The foxglove.PointCloud of a recorded cloud.

    Points are in the sensor (or vehicle) frame; ``pose`` is the pose of that frame in the world.

    Args:
        data: recorded bytes.
        where: file name in the recording, for error messages.
        stamp: timestamp.

    Raises:
        RecordingError: invalid data.
    """
    try:
        kept = decode(data, max_bytes=MAX_CLOUD_BYTES)
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
    """Fields of foxglove.PointCloud, and the packed point records."""
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
        raise ValueError("its poses are not rigid transforms")
    pose = T_world_sensor
    if kept["frame"] == "vehicle":
        pose = T_world_sensor @ np.linalg.inv(T_vehicle_sensor)
    w, x, y, z = matrix_to_quaternion(pose[:3, :3]).tolist()
    return {
        "position": dict(zip(AXES, pose[:3, 3].tolist(), strict=True)),
        "orientation": {"x": x, "y": y, "z": z, "w": w},
    }


MEDIA_TYPE = "application/vnd.real2sim.episode"
ATTACHMENT = "episode.r2e"
EGO_COLOUR, OBJECT_COLOUR, ROUTE_COLOUR = (0.4, 0.9, 0.4), (1.0, 0.55, 0.25), (0.6, 0.6, 0.6)

Topic = tuple[str, str]
"""Name of a topic and its schema."""
TRANSFORM: Topic = ("/tf", "foxglove.FrameTransform")
SCENE: Topic = ("/scene", "foxglove.SceneUpdate")
PLAN: Topic = ("/plan", "foxglove.PosesInFrame")
EGO: Topic = ("/ego", "real2sim.Ego")
METRICS: Topic = ("/metrics", "real2sim.Metrics")
CONTACT: Topic = ("/contact", "real2sim.Contact")
IMAGE_SCHEMA = "foxglove.CompressedImage"
CLOUD_SCHEMA = "foxglove.PointCloud"


def save_mcap(recording: Recording, path: Path) -> Path:
    """Write the episode atomically: poses, objects, plans, contacts, scores, images and clouds.

    Raises:
        RecordingError: the ``mcap`` extra is not installed.
    """
    data = mcap_bytes(recording)
    with atomic_file(path) as file:
        file.write(data)
    return path


def mcap_bytes(recording: Recording) -> bytes:
    """The content of the file; deterministic. Raises RecordingError like save_mcap()."""
    writer_class = _mcap("writer").Writer
    file = io.BytesIO()
    writer = writer_class(file)
    writer.start(profile="", library="real2sim")
    channels: dict[str, int] = {}
    for topic, t_us, message in _messages(recording):
        name, schema = topic
        if name not in channels:
            channels[name] = json_channel(writer, name, schema, message)
        body = json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
        writer.add_message(channels[name], t_us * 1000, body, t_us * 1000)
    first = recording.instants[0].t_us * 1000
    writer.add_attachment(first, first, ATTACHMENT, MEDIA_TYPE, to_bytes(recording))
    writer.add_metadata("real2sim", {"scene": recording.scene, "scene_hash": recording.scene_hash})
    writer.finish()
    return file.getvalue()


def recording_in(path: Path) -> Recording:
    """Read the recording attached to an MCAP file of this package.

    Raises:
        RecordingError: the file has no recording, or the ``mcap`` extra is not installed.
        OSError: the file cannot be read.
    """
    reader_module = _mcap("reader")
    with path.open("rb") as file:
        try:
            found = next(
                (
                    bytes(a.data)
                    for a in reader_module.make_reader(file).iter_attachments()
                    if a.name == ATTACHMENT and a.media_type == MEDIA_TYPE
                ),
                None,
            )
        # A damaged file can raise almost any error.
        except Exception as error:
            raise RecordingError(f"{path} is not an MCAP file, or is broken: {error}") from error
    if found is None:
        raise RecordingError(f"{path} holds no episode of this program")
    return recording_of_bytes(found, f"{path} ({ATTACHMENT})")


def _mcap(module: str) -> Any:
    import importlib

    try:
        return importlib.import_module(f"mcap.{module}")
    except ImportError as error:
        raise RecordingError(
            "MCAP files need the mcap extra: pip install 'real2sim[mcap]'"
        ) from error


def _messages(recording: Recording) -> Iterator[tuple[Topic, int, dict[str, Any]]]:
    """Topic, time and content of every message, by time."""
    frames = _frames_by_step(recording.frames)
    for instant, accumulator in zip(recording.instants, recording.accumulators(), strict=True):
        t_us, stamp = instant.t_us, stamp_of(instant.t_us)
        yield TRANSFORM, t_us, _transform(instant, stamp)
        yield SCENE, t_us, _scene(recording, instant, stamp)
        yield EGO, t_us, {"timestamp": stamp, **instant.ego._asdict()}
        if instant.plan is not None:
            yield PLAN, t_us, _plan(instant, stamp)
        for contact in instant.contacts:
            fields = asdict(contact) | {"impulse": list(contact.impulse)}
            yield CONTACT, t_us, {"timestamp": stamp, **fields}
        metrics = scoring.running_metrics(accumulator, recording.context)
        yield METRICS, t_us, {"timestamp": stamp, **metrics}
        for name, suffix, data in frames.get(instant.step, ()):
            if suffix == SUFFIX:
                sensor, modality = name.split("/")
                cloud = foxglove_cloud(data, f"{name}/{instant.step}", stamp)
                yield (f"/{modality}/{sensor}", CLOUD_SCHEMA), t_us, cloud
                continue
            yield (f"/camera/{name}", IMAGE_SCHEMA), t_us, _image(name, suffix, data, stamp)


def _frames_by_step(frames: Mapping[str, bytes]) -> dict[int, list[tuple[str, str, bytes]]]:
    found: dict[int, list[tuple[str, str, bytes]]] = {}
    for path, data in sorted(frames.items()):
        _, camera, modality, file = path.split("/")
        step, suffix = file.split(".")
        found.setdefault(int(step), []).append((f"{camera}/{modality}", suffix, data))
    return found


def stamp_of(t_us: int) -> dict[str, int]:
    """A time [us] as a timestamp of Foxglove's schemas."""
    return {"sec": t_us // 1_000_000, "nsec": t_us % 1_000_000 * 1000}


def _transform(instant: Instant, stamp: dict[str, int]) -> dict[str, Any]:
    ego = instant.ego
    return {
        "timestamp": stamp,
        "parent_frame_id": "world",
        "child_frame_id": "ego",
        "translation": {"x": ego.x, "y": ego.y, "z": ego.z},
        "rotation": _rotation(ego.yaw),
    }


def _scene(recording: Recording, instant: Instant, stamp: dict[str, int]) -> dict[str, Any]:
    others, size = instant.others, recording.context.ego_size
    ahead = {"x": recording.context.centre_ahead, "y": 0.0, "z": size[2] / 2}
    cube = {"pose": {"position": ahead, "orientation": _rotation(0.0)}}
    entities = [_entity("ego", "ego", stamp, cubes=[cube | _sized(size, EGO_COLOUR)])]
    for k, object_id in enumerate(others.ids):
        pose = {
            "position": _vector(others.centres[k]),
            "orientation": _rotation(float(others.yaws[k])),
        }
        cube = {"pose": pose, **_sized(others.sizes[k], OBJECT_COLOUR)}
        labels = {"category": others.categories[k]}
        entities.append(_entity(object_id, "world", stamp, cubes=[cube], labels=labels))
    if instant.step == 0:
        entities.append(_entity("route", "world", stamp, lines=[_route(recording, instant.ego.z)]))
    return {"deletions": [], "entities": entities}


def _entity(
    name: str,
    frame: str,
    stamp: dict[str, int],
    *,
    cubes: Iterable[dict[str, Any]] = (),
    lines: Iterable[dict[str, Any]] = (),
    labels: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    return {
        "timestamp": stamp,
        "frame_id": frame,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": frame == "ego",
        "metadata": [{"key": k, "value": v} for k, v in (labels or {}).items()],
        "cubes": list(cubes),
        "lines": list(lines),
    }


def _route(recording: Recording, z: float) -> dict[str, Any]:
    return {
        "type": 0,
        "pose": {"position": _vector((0.0, 0.0, 0.0)), "orientation": _rotation(0.0)},
        "thickness": 0.1,
        "scale_invariant": False,
        "points": [_vector((x, y, z)) for x, y in recording.context.route.tolist()],
        "color": _colour(ROUTE_COLOUR),
    }


def _plan(instant: Instant, stamp: dict[str, int]) -> dict[str, Any]:
    assert instant.plan is not None
    poses = [
        {"position": _vector((x, y, instant.ego.z)), "orientation": _rotation(yaw)}
        for x, y, yaw in instant.plan.poses.tolist()
    ]
    return {"timestamp": stamp, "frame_id": "world", "poses": poses}


def _image(name: str, suffix: str, data: bytes, stamp: dict[str, int]) -> dict[str, Any]:
    return {
        "timestamp": stamp,
        "frame_id": name.split("/", maxsplit=1)[0],
        "data": base64.b64encode(data).decode(),
        "format": "jpeg" if suffix == "jpg" else suffix,
    }


def _sized(size: Any, colour: tuple[float, float, float]) -> dict[str, Any]:
    return {"size": _vector(size), "color": _colour(colour)}


def _vector(values: Any) -> dict[str, float]:
    return {axis: float(value) for axis, value in zip("xyz", values, strict=True)}


def _rotation(yaw: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _colour(colour: tuple[float, float, float]) -> dict[str, float]:
    r, g, b = colour
    return {"r": r, "g": g, "b": b, "a": 0.7}


# --- schemas ----------------------------------------------------------------------------------


def json_channel(writer: Any, name: str, schema: str, example: dict[str, Any]) -> int:
    """Register a topic with a JSON schema inferred from its first message."""
    described = _described(example) | {"title": schema}
    if schema in {IMAGE_SCHEMA, CLOUD_SCHEMA}:
        described["properties"]["data"]["contentEncoding"] = "base64"
    data = json.dumps(described).encode()
    schema_id = writer.register_schema(schema, "jsonschema", data)
    channel: int = writer.register_channel(name, "json", schema_id)
    return channel


def _described(value: Any) -> dict[str, Any]:
    if isinstance(value, dict):
        return {"type": "object", "properties": {k: _described(v) for k, v in value.items()}}
    if isinstance(value, list):
        return {"type": "array", "items": _described(value[0]) if value else {}}
    known = {bool: "boolean", int: "integer", float: "number", str: "string"}
    return {"type": known[type(value)]} if type(value) in known else {}
