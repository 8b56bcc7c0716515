"""Scenes as files of other programs: splat files, baked or one per object, and glTF 2.0.

glTF uses KHR_gaussian_splatting (github.com/KhronosGroup/glTF, extensions/2.0/Khronos): each object
is a node, its track an animation.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from ..._files import atomic_file, atomic_folder
from ...geometry import Float, invert_transform, matrix_to_quaternion
from ..camera import Camera
from ..cloud import SH_C0, GaussianCloud
from ..errors import BundleError, SceneError
from ..scene import Scene, SceneObject
from ..trajectory import Trajectory
from .document import Vector3, Vector4
from .splat_format import UpAxis, host_array
from .splats import (
    FORMATS,
    VIEW_DURATION_US,
    format_to_write,
    read_splats,
    scene_from_cloud,
    upright,
    within_reach,
    write_splats,
)

# Writer of binary glTF 2.0 containers.

FLOAT, UNSIGNED_BYTE = 5126, 5121
ARRAY_BUFFER = 34962
MAX_GLB_BYTES = 0xFFFFFFFF
"""Maximum length of a glb file, which stores lengths in 32 bits."""

_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"float32": FLOAT, "uint8": UNSIGNED_BYTE}


class GlbWriter:
    """Collects arrays as accessors with a buffer view each, and writes the file."""

    def __init__(self) -> None:
        self._parts: list[NDArray[Any]] = []
        self._nbytes = 0
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], *, bounds: bool = False, vertices: bool = True) -> int:
        """Append an array [N] or [N, 3 or 4], N >= 1, float32 or (normalised) uint8.

        Args:
            array: the values; referenced, not copied.
            bounds: also write minimum and maximum, required for positions and key times.
            vertices: whether it belongs to vertices or to an animation.

        Returns:
            Index of the accessor.
        """
        width = 1 if array.ndim == 1 else array.shape[1]
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": self._nbytes,
            "byteLength": array.nbytes,
        }
        if vertices:
            view["target"] = ARRAY_BUFFER
        accessor: dict[str, Any] = {
            "bufferView": len(self._views),
            "componentType": _COMPONENTS[array.dtype.name],
            "count": len(array),
            "type": _TYPES[width],
        }
        if array.dtype == np.uint8:
            accessor["normalized"] = True
        if bounds:
            rows = array.reshape(len(array), width)
            accessor["min"] = rows.min(axis=0).tolist()
            accessor["max"] = rows.max(axis=0).tolist()
        self._views.append(view)
        self._accessors.append(accessor)
        self._parts.append(array)
        self._nbytes += array.nbytes + -array.nbytes % 4
        return len(self._accessors) - 1

    def write(self, document: dict[str, Any], path: Path) -> None:
        """Write ``document`` with all accessors so far, atomically.

        Raises:
            SceneError: for values JSON cannot hold, or more than 4 GiB.
            OSError: the file cannot be written.
        """
        if self._parts:
            document = document | {
                "buffers": [{"byteLength": self._nbytes}],
                "bufferViews": self._views,
                "accessors": self._accessors,
            }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + (8 + self._nbytes if self._parts else 0)
        if total > MAX_GLB_BYTES:
            raise SceneError(
                f"{path}: {total} bytes; a glb file holds at most {MAX_GLB_BYTES}; export objects "
                "one by one or as spz"
            )
        with atomic_file(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total))
            file.write(struct.pack("<I4s", len(text), b"JSON"))
            file.write(text)
            if self._parts:
                file.write(struct.pack("<I4s", self._nbytes, b"BIN\0"))
            for part in self._parts:
                # In the memory layout of vertices: little-endian, row by row.
                file.write(np.ascontiguousarray(part, dtype=part.dtype.newbyteorder("<")).data)
                file.write(b"\0" * (-part.nbytes % 4))


# Scene to glTF.

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0

T_OPTICAL_GLTF = np.diag([1.0, -1.0, -1.0, 1.0])
"""Rotation from a glTF camera (y up, looking along -z) to an OpenCV one."""

FAR_PLANE = 1000.0
NEAR_PLANE = 0.05


def write_gltf(
    scene: Scene, path: Path, *, objects: Mapping[str, SceneObject], t_us: int | None
) -> None:
    """Write ``scene`` with ``objects`` as one ``.glb``, atomically.

    The root node rotates the scene (z up) to glTF's y up and z forward. Below it are the
    ``background``, one node per object named by its id, and ``ego`` with the cameras. Gaussians of
    an object are in its own frame. Without ``t_us``, nodes are animated in seconds since
    ``extras.start_us``: translation and rotation LINEAR, as trajectories interpolate, and a STEP
    scale of zero while an object does not exist, because glTF hides nodes by scale. With ``t_us``,
    everything has its pose at that time, and all of ``objects`` must exist then.

    Scales and opacities are linear, as in the extension; ``COLOR_0`` lets viewers without it show
    points. The sky and a camera's principal point are not in the file (the latter is in the node's
    ``extras``).

    Raises:
        SceneError: values that are not finite or out of range, or more than 4 GiB.
        OSError: the file cannot be written.
    """
    scene.background.check_values(f"background for {path}")
    for object_id, scene_object in objects.items():
        scene_object.cloud.check_values(f"object {object_id!r} for {path}")
    builder = _Builder(scene, objects, t_us)
    builder.writer.write(builder.document(), path)


class _Builder:
    """Nodes, meshes and channels of one file."""

    def __init__(self, scene: Scene, objects: Mapping[str, SceneObject], t_us: int | None) -> None:
        self.writer = GlbWriter()
        self.t_us = t_us
        tracks = [scene.ego, *(o.trajectory for o in objects.values())]
        self.start_us = min(t.start_us for t in tracks)
        self.end_us = max(t.end_us for t in tracks)
        self.nodes: list[dict[str, Any]] = []
        self.meshes: list[dict[str, Any]] = []
        self.cameras: list[dict[str, Any]] = []
        self.channels: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []
        children = [self._add_cloud_node(scene.background, {"name": "background"})]
        children += [self._add_object(o) for o in objects.values()]
        children.append(self._add_ego(scene))
        self.root = self._add_node(
            {"name": scene.name, "children": children} | _pose(invert_transform(upright("y", 0.0)))
        )
        self.extras = {
            "start_us": self.start_us if t_us is None else t_us,
            "content_hash": scene.content_hash,
        }

    def document(self) -> dict[str, Any]:
        """The JSON part, except buffers and accessors."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "real2sim", "extras": self.extras},
            "scene": 0,
            "scenes": [{"nodes": [self.root]}],
            "nodes": self.nodes,
        }
        if self.meshes:
            document |= {"extensionsUsed": [EXTENSION], "meshes": self.meshes}
        if self.cameras:
            document["cameras"] = self.cameras
        if self.channels:
            document["animations"] = [
                {"name": "drive", "channels": self.channels, "samplers": self.samplers}
            ]
        return document

    def _add_node(self, node: dict[str, Any]) -> int:
        self.nodes.append(node)
        return len(self.nodes) - 1

    def _add_cloud_node(self, cloud: GaussianCloud, node: dict[str, Any]) -> int:
        # An accessor needs at least one element, so an empty cloud becomes a node without a mesh.
        if len(cloud):
            node["mesh"] = len(self.meshes)
            self.meshes.append({"primitives": [_primitive(self.writer, cloud)]})
        return self._add_node(node)

    def _add_object(self, scene_object: SceneObject) -> int:
        extras = {
            "object_id": scene_object.object_id,
            "category": scene_object.category,
            "size": list(scene_object.size),
        }
        node = {"name": scene_object.object_id, "extras": extras}
        index = self._add_cloud_node(scene_object.cloud, node)
        self._move(index, scene_object.trajectory)
        return index

    def _add_ego(self, scene: Scene) -> int:
        cameras = [self._add_camera(camera) for camera in scene.rig]
        node: dict[str, Any] = {"name": "ego", "extras": {"size": list(scene.ego_size)}}
        index = self._add_node(node | ({"children": cameras} if cameras else {}))
        self._move(index, scene.ego)
        return index

    def _add_camera(self, camera: Camera) -> int:
        lens = {
            "type": "perspective",
            "perspective": {
                "aspectRatio": camera.width * camera.K[1, 1] / (camera.height * camera.K[0, 0]),
                "yfov": 2 * float(np.arctan(camera.height / 2 / camera.K[1, 1])),
                "znear": NEAR_PLANE,
                "zfar": FAR_PLANE,
            },
        }
        self.cameras.append(lens)
        extras = {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}
        node = {"name": camera.name, "camera": len(self.cameras) - 1, "extras": extras}
        return self._add_node(node | _pose(camera.T_vehicle_camera @ T_OPTICAL_GLTF))

    def _move(self, index: int, trajectory: Trajectory) -> None:
        """Place a node at ``t_us``, or at its first pose with animation channels for all poses."""
        at = trajectory.start_us if self.t_us is None else self.t_us
        self.nodes[index] |= _pose(trajectory.transform(at))
        if self.t_us is not None:
            return
        if len(trajectory.times_us) > 1:
            seconds = self.writer.add(
                self._seconds(trajectory.times_us), bounds=True, vertices=False
            )
            self._add_channel(index, "translation", seconds, trajectory.positions)
            rotations = _continuous(trajectory.quaternions)[:, [1, 2, 3, 0]]
            self._add_channel(index, "rotation", seconds, rotations)
        self._hide_outside(index, trajectory)

    def _hide_outside(self, index: int, trajectory: Trajectory) -> None:
        """Scale of zero before and after the trajectory, if the drive is longer."""
        first, last = self._seconds(np.array([trajectory.start_us, trajectory.end_us]))
        times, scales = [first], [1.0]
        if first > 0:
            times, scales = [np.float32(0), first], [0.0, 1.0]
        if trajectory.end_us < self.end_us:
            # The object is still visible at the last instant, so the step comes right after it.
            times.append(np.nextafter(last, np.float32(np.inf)))
            scales.append(0.0)
        if 0.0 in scales:
            key = self.writer.add(np.array(times, np.float32), bounds=True, vertices=False)
            values = np.repeat(np.array(scales)[:, None], 3, axis=1)
            self._add_channel(index, "scale", key, values, interpolation="STEP")

    def _add_channel(
        self, node: int, path: str, key: int, values: Float, *, interpolation: str = "LINEAR"
    ) -> None:
        output = self.writer.add(values.astype(np.float32), vertices=False)
        target = {"node": node, "path": path}
        self.channels.append({"sampler": len(self.samplers), "target": target})
        self.samplers.append({"input": key, "interpolation": interpolation, "output": output})

    def _seconds(self, times_us: NDArray[np.int64]) -> NDArray[np.float32]:
        seconds = ((times_us - self.start_us) / 1e6).astype(np.float32)
        # Key times must increase strictly; float32 cannot resolve closer times.
        for i in np.flatnonzero(np.diff(seconds) <= 0) + 1:
            seconds[i] = np.nextafter(seconds[i - 1], np.float32(np.inf))
        return seconds


def _pose(transform: Float) -> dict[str, Any]:
    """``translation`` and ``rotation`` (xyzw) of a node."""
    quaternion = matrix_to_quaternion(transform[:3, :3])
    return {
        "translation": transform[:3, 3].tolist(),
        "rotation": quaternion[[1, 2, 3, 0]].tolist(),
    }


def _continuous(quaternions: Float) -> Float:
    """The same rotations with signs such that adjacent ones are less than half a turn apart."""
    dots = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
    signs = np.cumprod(np.concatenate([[1.0], np.where(dots < 0, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def _primitive(writer: GlbWriter, cloud: GaussianCloud) -> dict[str, Any]:
    """A POINTS primitive with the extension's attributes."""

    def host(values: torch.Tensor) -> NDArray[np.float32]:
        return np.ascontiguousarray(values.detach().cpu().numpy(), dtype=np.float32)

    rgb = 0.5 + SH_C0 * host_array(cloud.sh[:, 0])
    rgba = np.concatenate([rgb, host_array(cloud.opacities)[:, None]], axis=1)
    # Clouds allow an error of 0.001; glTF requires unit length.
    quats = torch.nn.functional.normalize(cloud.quats.double(), dim=1)
    attributes = {
        "POSITION": writer.add(host(cloud.means), bounds=True),
        "COLOR_0": writer.add(np.clip(np.rint(rgba * 255), 0, 255).astype(np.uint8)),
        f"{EXTENSION}:ROTATION": writer.add(host(quats[:, [1, 2, 3, 0]])),
        f"{EXTENSION}:SCALE": writer.add(host(cloud.scales)),
        f"{EXTENSION}:OPACITY": writer.add(host(cloud.opacities)),
    }
    for degree in range(cloud.sh_degree + 1):
        for n in range(2 * degree + 1):
            coefficients = host(cloud.sh[:, degree * degree + n])
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = writer.add(coefficients)
    return {
        "mode": POINTS,
        "attributes": attributes,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }


INDEX_NAME = "objects.json"
INDEX_FORMAT = "real2sim-objects"


def export_scene(
    scene: Scene,
    out: str | PathLike[str],
    *,
    format: str,
    t_us: int | None = None,
    objects: Iterable[str] | None = None,
    up_axis: UpAxis | None = None,
) -> tuple[Path, ...]:
    """Write a scene for other programs, atomically; existing content of ``out`` is replaced.

    ``gltf`` gives one ``.glb`` with a node per object: animated along its track, or with ``t_us``
    at its pose at that time (see :func:`write_gltf`). The splat formats give, with
    ``t_us``, one file of all Gaussians in the world at that time. Without it they give a folder:
    the background, each object in its own frame (origin at the box centre), and ``objects.json``
    with file, category, size and track of each. None of them contains the sky.

    Args:
        scene: scene to write.
        out: file to write, or folder for separate object files.
        format: ``gltf``, or the suffix of a splat format without its dot.
        t_us: time to bake [us]; objects that do not exist then are omitted.
        objects: ids of objects to write besides the background; default all.
        up_axis: axis of the files that points up, ``z``, ``y`` or ``-y``, as in
            ``import_splats``; the default depends on the format: ``y`` for spz, else ``z``. glTF is
            always y up.

    Returns:
        The files written.

    Raises:
        SceneError: an unknown format, object or axis, a time outside the scene, an unsuitable
            ``out``, or values that are not finite or not representable in the format.
        OSError: a file cannot be written.
    """
    splat_formats = {known.suffix[1:]: known for known in FORMATS}
    if format not in {*splat_formats, "gltf"}:
        names = ", ".join([*splat_formats, "gltf"])
        raise SceneError(f"export format {format!r}; allowed are {names}")
    chosen = _chosen(scene, objects)
    if t_us is not None:
        _check_time(scene, t_us)
        chosen = {k: o for k, o in chosen.items() if o.trajectory.covers(t_us)}
    path = Path(out)
    if format == "gltf":
        if up_axis not in (None, "y"):
            raise SceneError(f"up_axis {up_axis!r}; glTF is always y up")
        _check_file(path, ".glb")
        write_gltf(scene, path, objects=chosen, t_us=t_us)
        return (path,)
    axis = up_axis or splat_formats[format].up_axis
    turn = invert_transform(upright(axis, 0.0))
    if t_us is None:
        return _write_folder(scene, chosen, path, f".{format}", axis)
    _check_file(path, f".{format}")
    if format_to_write(path).suffix != f".{format}":
        raise SceneError(f"{path}: this ending means {format_to_write(path).name}, not {format}")
    write_splats(bake(scene, t_us, objects=chosen).moved(turn), path, up_axis=axis)
    return (path,)


def bake(
    scene: Scene, t_us: int, *, objects: Mapping[str, SceneObject] | None = None
) -> GaussianCloud:
    """All Gaussians in the world at ``t_us``: the background first, then objects.

    Objects (default: all of the scene) that do not exist at that time are omitted.
    """
    placed = [
        o.cloud.moved(o.trajectory.transform(t_us))
        for o in (scene.objects if objects is None else objects).values()
        if o.trajectory.covers(t_us)
    ]
    return GaussianCloud.concatenate([scene.background, *placed])


def _chosen(scene: Scene, objects: Iterable[str] | None) -> dict[str, SceneObject]:
    if isinstance(objects, str):
        raise SceneError(f"objects must be a list of ids, not the text {objects!r}")
    wanted = None if objects is None else {scene.object(o).object_id for o in objects}
    return {k: o for k, o in scene.objects.items() if wanted is None or k in wanted}


def _check_time(scene: Scene, t_us: int) -> None:
    if not scene.start_us <= t_us <= scene.end_us:
        raise SceneError(
            f"t_us={t_us} is outside scene {scene.name!r}; allowed are {scene.start_us} to "
            f"{scene.end_us}"
        )


def _check_file(path: Path, suffix: str) -> None:
    if not path.name.lower().endswith(suffix):
        raise SceneError(f"{path}: the name of this file must end with {suffix}")
    if path.is_dir():
        raise SceneError(f"{path}: is a folder; name a file")


def _write_folder(
    scene: Scene, objects: dict[str, SceneObject], out: Path, suffix: str, axis: UpAxis
) -> tuple[Path, ...]:
    """Background and objects as separate files, each in its own frame with ``axis`` up."""
    turn = invert_transform(upright(axis, 0.0))
    if out.exists() and not _is_replaceable(out):
        raise SceneError(
            f"{out}: is there and holds something else than an export; choose another folder or "
            "remove it"
        )
    names = {k: _file_name(i, k) + suffix for i, k in enumerate(objects, start=1)}
    background = f"background{suffix}"
    with atomic_folder(out) as folder:
        write_splats(scene.background.moved(turn), folder / background, up_axis=axis)
        for object_id, scene_object in objects.items():
            cloud = scene_object.cloud.moved(turn)
            write_splats(cloud, folder / names[object_id], up_axis=axis)
        with atomic_file(folder / INDEX_NAME) as file:
            index = _index(scene, objects, names, background=background, turn=turn)
            file.write(json.dumps(index, indent=1).encode())
    return tuple(out / name for name in (background, *names.values(), INDEX_NAME))


def _is_replaceable(out: Path) -> bool:
    """Whether a folder is empty or an earlier export, so that no other data is overwritten."""
    if not out.is_dir():
        return False
    if not any(out.iterdir()):
        return True
    try:
        index = json.loads((out / INDEX_NAME).read_bytes())
        known = {index["background"], INDEX_NAME, *(o["file"] for o in index["objects"])}
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return index.get("format") == INDEX_FORMAT and {p.name for p in out.iterdir()} <= known


def _file_name(index: int, object_id: str) -> str:
    """A safe file name; the number distinguishes similar ids."""
    return f"{index:03d}_{re.sub(r'[^A-Za-z0-9_-]', '_', object_id)[:60]}"


def _index(
    scene: Scene,
    objects: dict[str, SceneObject],
    names: dict[str, str],
    *,
    background: str,
    turn: Float,
) -> dict[str, Any]:
    """Content of ``objects.json``: the files, and the trajectories of their objects."""
    return {
        "format": INDEX_FORMAT,
        "version": 1,
        "scene": scene.name,
        "content_hash": scene.content_hash,
        "T_file_scene": turn.tolist(),
        "background": background,
        "objects": [
            {
                "object_id": k,
                "file": names[k],
                "category": o.category,
                "size": list(o.size),
                "times_us": o.trajectory.times_us.tolist(),
                "positions": o.trajectory.positions.tolist(),
                "quaternions_wxyz": o.trajectory.quaternions.tolist(),
            }
            for k, o in objects.items()
        ],
    }


class _IndexedObject(BaseModel):
    object_id: str
    file: str
    category: str
    size: Vector3
    times_us: list[int]
    positions: list[Vector3]
    quaternions_wxyz: list[Vector4]


class _ObjectIndex(BaseModel):
    """Content of ``objects.json``."""

    format: Literal["real2sim-objects"]
    version: Literal[1]
    scene: str
    content_hash: str | None
    T_file_scene: list[Vector4]
    background: str
    objects: list[_IndexedObject]


def import_exported(path: str | PathLike[str], *, name: str, max_bytes: int | None = None) -> Scene:
    """Read a folder of :func:`export_scene` as a scene: background, objects and their tracks.

    Args:
        path: folder with ``objects.json``.
        name: name of the scene.
        max_bytes: memory limit of the Gaussians of each file; None for no limit.

    Raises:
        BundleTooLargeError: the limit is exceeded.
        BundleError: names the file and the reason.
        SceneError: the objects are not valid.
    """
    folder = Path(path)
    try:
        index = _ObjectIndex.model_validate_json((folder / INDEX_NAME).read_bytes())
    except OSError as error:
        raise BundleError(
            f"{folder}: a folder without {INDEX_NAME}; give a splat file, or a folder that "
            "real2sim export has written"
        ) from error
    except ValidationError as error:
        raise BundleError(f"{folder / INDEX_NAME}: {error}") from error
    turns = {axis: upright(axis, 0.0) for axis in get_args(UpAxis)}
    given = np.array(index.T_file_scene)
    axis = next(
        (axis for axis, turn in turns.items() if np.array_equal(given, invert_transform(turn))),
        None,
    )
    if axis is None:
        raise BundleError(f"{folder / INDEX_NAME}: T_file_scene is not the rotation of an up axis")
    notes: list[str] = []

    def cloud_of(file: str) -> GaussianCloud:
        if Path(file).name != file:
            raise BundleError(
                f"{folder / INDEX_NAME}: {file!r} is not the name of a file beside it"
            )
        own: list[str] = []
        cloud = read_splats(folder / file, max_bytes=max_bytes, notes=own)
        cloud = within_reach(cloud.moved(turns[axis]), folder / file, own)
        notes.extend(f"{file}: {sentence}" for sentence in own)
        return cloud

    background = cloud_of(index.background)
    if not len(background):
        raise BundleError(f"{folder / index.background}: holds no splats; nothing to import")
    objects = {
        o.object_id: SceneObject(
            o.object_id,
            o.category,
            o.size,
            cloud_of(o.file),
            Trajectory(
                np.array(o.times_us, dtype=np.int64),
                np.array(o.positions),
                np.array(o.quaternions_wxyz),
            ),
        )
        for o in index.objects
    }
    provenance = {
        "source": "exported folder",
        "file": folder.name,
        "scene": index.scene,
        "scene_hash": index.content_hash,
        "up_axis": axis,
        "notes": notes,
    }
    starts = [o.trajectory.start_us for o in objects.values()]
    ends = [o.trajectory.end_us for o in objects.values()]
    start = min(starts, default=0)
    times_us = (start, max([*ends, start + VIEW_DURATION_US]))
    scene = scene_from_cloud(background, name=name, provenance=provenance, times_us=times_us)
    return replace(scene, objects=objects)
