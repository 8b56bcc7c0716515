"""NCore v4: one store per clip, with poses, calibration, cameras, LiDAR and cuboids.

Source: the components of ``ncore.data.v4`` (NVIDIA NCore, data version v4). The images and points
of a frame refer to one instant, with the LiDAR at its position at that time. Frames of reference
are ``world``, ``rig`` (the ego), one per camera, and ``lidar_top``.
"""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...geometry import Float
from ...render import encode_image
from ...scene import Camera
from ..clips import Clip
from .writer import LabelledDrive

# --- Zarr ----------------------------------------------------------------------------------------

# A version 2 store as a folder. Sources: the specification of zarr's storage, version 2; RFC 8949
# (CBOR) for the file with NCore's metadata.

ZLIB_LEVEL = 1
SIMPLE = {False: b"\xf4", True: b"\xf5", None: b"\xf6"}
CONSOLIDATED = ".zmetadata.cbor.xz"


class ZarrStore:
    """A store that is written once, starting at its root.

    Args:
        folder: folder of the store; newly created.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._metadata: dict[str, Any] = {}

    def group(self, path: str, attributes: Mapping[str, Any] | None = None) -> str:
        """Create a group at ``path`` (empty: the root) and return it."""
        self._write(path, ".zgroup", {"zarr_format": 2})
        if attributes is not None:
            self._write(path, ".zattrs", dict(attributes))
        return path

    def array(
        self, path: str, values: NDArray[Any], attributes: Mapping[str, Any] | None = None
    ) -> None:
        """An array in one chunk."""
        values = np.ascontiguousarray(values)
        content = {
            "zarr_format": 2,
            "shape": list(values.shape),
            "chunks": [max(1, side) for side in values.shape],
            "dtype": values.dtype.str,
            "compressor": {"id": "zlib", "level": ZLIB_LEVEL},
            "fill_value": 0,
            "order": "C",
            "filters": None,
        }
        self._write(path, ".zarray", content)
        if attributes is not None:
            self._write(path, ".zattrs", dict(attributes))
        if values.size:
            chunk = zlib.compress(values.tobytes(), ZLIB_LEVEL)
            (self._folder / path / ".".join("0" * values.ndim)).write_bytes(chunk)

    def encoded(self, path: str, data: bytes, attributes: Mapping[str, Any]) -> None:
        """Store bytes unchanged; they must not end with a zero."""
        content = {
            "zarr_format": 2,
            "shape": [],
            "chunks": [],
            "dtype": f"|S{len(data)}",
            "compressor": None,
            "fill_value": None,
            "order": "C",
            "filters": None,
        }
        self._write(path, ".zarray", content)
        self._write(path, ".zattrs", dict(attributes))
        (self._folder / path / "0").write_bytes(data)

    def consolidate(self) -> None:
        """Write the metadata of all groups and arrays into one file."""
        content = {"zarr_consolidated_format": 1, "metadata": self._metadata}
        (self._folder / CONSOLIDATED).write_bytes(lzma.compress(cbor(content)))

    def _write(self, path: str, name: str, content: dict[str, Any]) -> None:
        self._metadata[f"{path}/{name}" if path else name] = content
        place = self._folder / path
        place.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def cbor(value: Any) -> bytes:
    """A JSON value as CBOR."""
    if value is None or isinstance(value, bool):
        return SIMPLE[value]
    if isinstance(value, int):
        return _head(0, value) if value >= 0 else _head(1, -1 - value)
    if isinstance(value, float):
        return b"\xfb" + struct.pack(">d", value)
    if isinstance(value, str):
        text = value.encode()
        return _head(3, len(text)) + text
    if isinstance(value, Mapping):
        pairs = (cbor(key) + cbor(part) for key, part in value.items())
        return _head(5, len(value)) + b"".join(pairs)
    return _head(4, len(value)) + b"".join(cbor(part) for part in value)


def _head(kind: int, number: int) -> bytes:
    """Major type and argument."""
    if number < 24:
        return bytes([kind << 5 | number])
    for extra, code in enumerate("BHIQ"):
        if number < 1 << (8 << extra):
            return bytes([kind << 5 | 24 + extra]) + struct.pack(f">{code}", number)
    raise ValueError(f"{number} does not fit 64 bits")


VERSION, COMPONENT_VERSION = "v4", "v1"
INSTANCE = "default"
RIG, WORLD, LIDAR = "rig", "world", "lidar_top"
START_US = 1_000_000
"""Offset of all times [us], because NCore stores unsigned times."""
QUALITY = 95
LABELS = ("depth", "instance", "semantic")
POINT_LABELS = ("instance", "semantic", "velocity", "beam", "time_us", "return_number")


class NCoreWriter:
    """Writes ``<split>/<sequence>.ncore4.zarr``, one sequence per clip."""

    name = "ncore"
    holds = "v4 stores: poses, intrinsics, cameras and lidars with labels, cuboids"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        for clip in drive.clips:
            sequence = f"{drive.digest[:16]}_{clip.name}"
            store = ZarrStore(folder / clip.split / f"{sequence}.ncore4.zarr")
            _write_sequence(store, drive, clip, sequence)
            store.consolidate()


def _write_sequence(store: ZarrStore, drive: LabelledDrive, clip: Clip, sequence: str) -> None:
    times = [_stamp(frame) for frame in clip.frames]
    poses = [frame["T_world_ego"] for frame in clip.frames]
    if len(times) == 1:
        # A trajectory needs at least two poses.
        times, poses = [times[0], times[0] + 1], poses * 2
    store.group(
        "",
        {
            "sequence_id": sequence,
            "sequence_timestamp_interval_us": {"start": times[0], "stop": times[-1] + 1},
            "generic_meta_data": {"name": drive.name, "licence": drive.licence},
            "version": VERSION,
            "component_group_name": "",
        },
    )
    _write_poses(store, drive, {"poses": poses, "timestamps_us": times, "dtype": "float64"})
    _write_intrinsics(store, drive)
    for camera in drive.cameras:
        _write_camera(store, clip, camera)
    _write_lidar(store, clip, np.array(drive.lidar_position))
    place = _component(store, "cuboids", INSTANCE)
    cuboids = [row for frame in clip.frames for row in _cuboids(frame)]
    store.group(f"{place}/cuboids", {"cuboid_track_observations": cuboids})


def _component(store: ZarrStore, name: str, instance: str) -> str:
    """The path of a new component."""
    store.group(name)
    return store.group(
        f"{name}/{instance}",
        {
            "component_name": name,
            "component_instance_name": instance,
            "component_version": COMPONENT_VERSION,
            "generic_meta_data": {},
        },
    )


def _write_poses(store: ZarrStore, drive: LabelledDrive, ego: Mapping[str, Any]) -> None:
    place = _component(store, "poses", INSTANCE)
    roof = np.eye(4)
    roof[:3, 3] = drive.lidar_position
    mounts = {camera.name: camera.T_vehicle_camera for camera in drive.cameras} | {LIDAR: roof}
    static = {
        str((name, RIG)): {"pose": pose.tolist(), "dtype": "float64"}
        for name, pose in mounts.items()
    }
    store.group(f"{place}/static_poses", static)
    store.group(f"{place}/dynamic_poses", {str((RIG, WORLD)): dict(ego)})


def _write_intrinsics(store: ZarrStore, drive: LabelledDrive) -> None:
    place = _component(store, "intrinsics", INSTANCE)
    store.group(f"{place}/lidars")
    store.group(f"{place}/cameras")
    for camera in drive.cameras:
        parameters = {
            "resolution": [camera.width, camera.height],
            "shutter_type": "GLOBAL",
            "external_distortion_parameters": None,
            "principal_point": camera.K[:2, 2].tolist(),
            "focal_length": camera.K.diagonal()[:2].tolist(),
            "radial_coeffs": [0.0] * 6,
            "tangential_coeffs": [0.0] * 2,
            "thin_prism_coeffs": [0.0] * 4,
        }
        store.group(
            f"{place}/cameras/{camera.name}",
            {"camera_model_type": "opencv-pinhole", "camera_model_parameters": parameters},
        )


def _write_camera(store: ZarrStore, clip: Clip, camera: Camera) -> None:
    place = _component(store, "cameras", camera.name)
    _frames(store, place, clip)
    for frame in clip.frames:
        here, index = f"{place}/frames/{_stamp(frame)}", frame["index"]
        store.group(here)
        rgb = clip.pixels("rgb", camera.name, index)
        jpeg = encode_image(rgb, "rgb", "jpeg", quality=QUALITY).data
        store.encoded(f"{here}/image", jpeg, {"format": "jpeg"})
        views = [
            {k: v for k, v in view.items() if k != "T_camera_object"}
            for view in frame["views"][camera.name]
        ]
        store.group(f"{here}/generic_data", {"views": views})
        for label in LABELS:
            pixels = clip.pixels(label, camera.name, index)
            if label == "depth":
                pixels = pixels.astype(np.float32) / np.float32(256)
            store.array(f"{here}/generic_data/{label}", pixels)


def _write_lidar(store: ZarrStore, clip: Clip, position: Float) -> None:
    place = _component(store, "lidars", LIDAR)
    _frames(store, place, clip)
    for frame in clip.frames:
        rows, here = clip.points(frame["index"]), f"{place}/frames/{_stamp(frame)}"
        offsets = rows["xyz"].astype(np.float64) - position
        ranges = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
        store.group(here)
        store.group(f"{here}/generic_data")
        for label in POINT_LABELS:
            store.array(f"{here}/generic_data/{label}", rows[label])
        store.group(f"{here}/ray_bundle", {"n_rays": len(rows)})
        rays = (offsets / ranges[:, None]).astype(np.float32)
        store.array(f"{here}/ray_bundle/direction", rays)
        times = np.full(len(rows), _stamp(frame), np.uint64)
        store.array(f"{here}/ray_bundle/timestamp_us", times)
        returns = store.group(f"{here}/ray_bundle_returns", {"n_returns": 1})
        store.array(f"{returns}/distance_m", ranges[None].astype(np.float32))
        intensity = np.clip(rows["intensity"], 0, 1)[None]
        store.array(f"{returns}/intensity", intensity)
        store.array(
            f"{here}/ray_bundle_returns_valid_mask_packed",
            np.packbits(np.ones(len(rows), np.bool_)),
            {"n_returns": 1, "n_rays": len(rows)},
        )


def _frames(store: ZarrStore, place: str, clip: Clip) -> None:
    stamps = [[_stamp(frame)] * 2 for frame in clip.frames]
    store.group(f"{place}/frames", {"frames_timestamps_us": stamps})


def _cuboids(frame: Mapping[str, Any]) -> list[dict[str, Any]]:
    stamp = _stamp(frame)
    rows = []
    for subject in frame["objects"]:
        pose = np.array(subject["T_ego_object"])
        turns = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz").tolist()
        box = {"centroid": pose[:3, 3].tolist(), "dim": list(subject["size"]), "rot": turns}
        rows.append(
            {
                "track_id": subject["object_id"],
                "class_id": subject["category"],
                "timestamp_us": stamp,
                "reference_frame_id": RIG,
                "reference_frame_timestamp_us": stamp,
                "bbox3": box,
                "source": "GT_SYNTHETIC",
                "source_version": None,
            }
        )
    return rows


def _stamp(frame: Mapping[str, Any]) -> int:
    return int(frame["t_us"]) + START_US
