"""The project's own folder layout for logs; ``docs/log_format.md`` describes it for users."""

from __future__ import annotations

import difflib
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from ..._files import read_text
from ..._npy import read_entries, read_headers, read_npy
from ...scene import Camera, CameraRig, LaneGraph, SceneError, Trajectory
from ...scene.camera import Optics
from ...scene.errors import LeftOut
from ...scene.io.document import OpticsPart, lane_document, read_lanes
from ..driving_log import NO_SWEEP, DrivingLog, LidarSweep, LogError, ObjectTrack
from ..images import IMAGE_SUFFIXES, check_image_file, read_image, write_image
from .common import covered_frames
from .files import check_frame_times

FORMAT = "real2sim-log"
VERSION = 1
MANIFEST = "log.json"
LANES = "lanes.json"
MAX_SWEEP_BYTES = 1 << 30
"""Maximum size of an unpacked sweep: thirty million points."""
LOG_KEYS = (
    "format", "version", "name", "frame_times_us", "cameras", "ego", "tracks", "lidar",
    "image_times_us", "provenance",
)  # fmt: skip
CAMERA_KEYS = ("name", "width", "height", "K", "T_vehicle_camera", "recorded")
POSE_KEYS = ("times_us", "positions", "quaternions")
EGO_KEYS = ("size", *POSE_KEYS)
TRACK_KEYS = ("object_id", "category", "size", *POSE_KEYS)
SWEEP_SHAPES = {"points": (-1, 3), "intensity": (-1,), "offset_us": (-1,), "origin": (3,)}
"""Shapes of the arrays; -1 is the number of points."""
QUATERNION_TOLERANCE = 1e-2
MAX_OFFSET_US = 10_000_000
"""Maximum difference between the time of a point and its frame's [us]."""


class NativeReader:
    """Reads ``log.json`` with ``images/<camera>/%06d.png`` and ``lidar/%06d.npz``."""

    name = "native"
    expects = "log.json, images/<camera>/%06d.png (or .jpg), lidar/%06d.npz; see docs/log_format.md"

    def recognises(self, path: Path) -> bool:
        """Whether there is a ``log.json``."""
        return (path / MANIFEST).is_file()

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The log in the folder ``path``. ``sequence`` is rejected: a folder holds one log.

        Raises:
            LogError: see :class:`LogReader`.
        """
        manifest = path / MANIFEST
        if sequence is not None:
            raise LogError(f"{path}: holds one log; it has no sequence {sequence!r}")
        content = _JsonSection(_load(manifest), str(manifest)).only(LOG_KEYS)
        left_out = LeftOut()
        given = check_frame_times(content.integers("frame_times_us"), str(manifest))
        ego = content.section("ego").only(EGO_KEYS)
        path_driven = _read_trajectory(ego, left_out, "poses")
        frames = covered_frames(path_driven, given, left_out, str(manifest))
        rig = _read_rig(content, left_out)
        times_us = given[frames]
        images = _image_files(path, rig, frames)
        sweeps = [path / "lidar" / f"{f:06d}.npz" for f in frames]
        return DrivingLog(
            name=str(content.get("name", str)),
            rig=rig,
            frame_times_us=times_us,
            ego=path_driven,
            tracks=_read_tracks(content, left_out),
            source=_NativeSource(rig, images, sweeps if content.get("lidar", bool) else None),
            ego_size=ego.size("size"),
            provenance=content.get("provenance", dict) if "provenance" in content.content else {},
            image_times_us={
                name: taken[frames]
                for name, taken in _read_image_times(content, rig, given, left_out).items()
            },
            lanes=_read_lanes(path / LANES, left_out),
            left_out=left_out.told(),
        )


def _read_lanes(path: Path, left_out: LeftOut) -> LaneGraph | None:
    """The log's map; None without the file."""
    lanes = None
    if path.exists():
        with left_out.damaged("maps"):
            lanes = read_lanes(path)
    return lanes


def _load(manifest: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_text(manifest))
    except OSError as error:
        raise LogError(f"{manifest}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise LogError(f"{manifest}: is not a JSON file ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise LogError(f'{manifest}: expected an object with "format": "{FORMAT}"')
    if content.get("version") != VERSION:
        raise LogError(
            f"{manifest}: is version {content.get('version')!r}; this program reads {VERSION}"
        )
    return content


@dataclass(frozen=True, eq=False)
class _JsonSection:
    """A JSON object with checked access; ``where`` names it in errors."""

    content: Mapping[str, Any]
    where: str

    def only(self, keys: Sequence[str]) -> _JsonSection:
        """The section itself, after a check that it has no other keys."""
        for key in self.content:
            if key not in keys:
                like = difflib.get_close_matches(str(key), keys, n=1)
                meant = f"did you mean {like[0]!r}?" if like else f"known: {', '.join(keys)};"
                raise LogError(
                    f"{self.where}: unknown key {key!r}; {meant} What is yours alone belongs into "
                    "'provenance'"
                )
        return self

    def get(self, key: str, kind: type) -> Any:
        value = self.content.get(key)
        if not isinstance(value, kind) or isinstance(value, bool) != (kind is bool):
            found = "nothing" if key not in self.content else repr(value)[:80]
            raise LogError(f"{self.where}: {key!r} must be {kind.__name__}, found {found}")
        return value

    def section(self, key: str) -> _JsonSection:
        return _JsonSection(self.get(key, dict), f"{self.where}: {key}")

    def sections(self, key: str, left_out: LeftOut) -> list[_JsonSection]:
        found = []
        for i, item in enumerate(self.get(key, list)):
            where = f"{self.where}: {key}[{i}]"
            if isinstance(item, dict):
                found.append(_JsonSection(item, where))
            else:
                left_out[key].append(f"{where} must be an object, found {item!r}")
        return found

    def numbers(
        self, key: str, shape: tuple[int, ...], *, finite: bool = True
    ) -> NDArray[np.float64]:
        """Float64 array; -1 in ``shape`` matches any length."""
        try:
            values = np.array(self.get(key, list), dtype=np.float64)
        except (ValueError, TypeError) as error:
            raise LogError(f"{self.where}: {key!r} must be an array of numbers") from error
        if values.size == 0 and shape[0] == -1:
            values = values.reshape(0, *shape[1:])
        fits = len(values.shape) == len(shape) and all(
            want in (-1, given) for want, given in zip(shape, values.shape, strict=True)
        )
        if not fits:
            wanted = [n if n >= 0 else "N" for n in shape]
            raise LogError(f"{self.where}: {key!r} must be {wanted}, not {list(values.shape)}")
        if finite and not np.isfinite(values).all():
            raise LogError(f"{self.where}: {key!r} holds a value that is not finite")
        return values

    def integers(self, key: str) -> NDArray[np.int64]:
        values = self.get(key, list)
        if not all(isinstance(v, int) and not isinstance(v, bool) for v in values):
            raise LogError(f"{self.where}: {key!r} must be whole numbers [us]")
        return np.array(values, dtype=np.int64)

    def size(self, key: str) -> tuple[float, float, float]:
        length, width, height = (float(v) for v in self.numbers(key, (3,)))
        if min(length, width, height) <= 0:
            raise LogError(
                f"{self.where}: {key!r} must be positive (length, width, height), "
                f"not {[length, width, height]}"
            )
        return length, width, height


def _read_rig(content: _JsonSection, left_out: LeftOut) -> CameraRig:
    cameras: dict[str, Camera] = {}
    for entry in content.sections("cameras", left_out):
        entry.only(CAMERA_KEYS)
        with left_out.damaged("cameras"):
            name = entry.get("name", str)
            if not name or Path(name).name != name or name in cameras:
                raise LogError(
                    f"{entry.where}: 'name' must be usable as a folder name, and only once, not "
                    f"{name!r}"
                )
            k, pose = entry.numbers("K", (3, 3)), entry.numbers("T_vehicle_camera", (4, 4))
            try:
                size = entry.get("width", int), entry.get("height", int)
                cameras[name] = Camera(name, *size, k, pose, recorded=_read_optics(entry))
            except (SceneError, ValidationError) as error:
                raise LogError(f"{entry.where}: {error}") from error
    return CameraRig(tuple(cameras.values()))


def _read_optics(entry: _JsonSection) -> Optics | None:
    """Optics of the physical camera; the key is optional. Raises SceneError or ValidationError."""
    given = entry.content.get("recorded")
    return None if given is None else OpticsPart.model_validate(given).build()


def _read_trajectory(section: _JsonSection, left_out: LeftOut, kind: str) -> Trajectory:
    """The poses of a section; those that are not finite, or not in order, are left out."""
    times_us = section.integers("times_us")
    positions = section.numbers("positions", (-1, 3), finite=False)
    quaternions = section.numbers("quaternions", (-1, 4), finite=False)
    if not len(times_us) == len(positions) == len(quaternions):
        raise LogError(
            f"{section.where}: has {len(times_us)} times, {len(positions)} positions and "
            f"{len(quaternions)} quaternions"
        )
    norms = np.linalg.norm(quaternions, axis=1)
    kept: list[int] = []
    for i, t_us in enumerate(times_us.tolist()):
        where = f"{section.where}, pose {i} at {t_us} us"
        if not (np.isfinite(positions[i]).all() and abs(norms[i] - 1) < QUATERNION_TOLERANCE):
            left_out[kind].append(f"{where}: is not finite, or its quaternion not of unit length")
        elif kept and t_us <= times_us[kept[-1]]:
            left_out[kind].append(f"{where}: does not come after the pose before")
        else:
            kept.append(i)
    try:
        return Trajectory(times_us[kept], positions[kept], quaternions[kept])
    except SceneError as error:
        raise LogError(f"{section.where}: {error}") from error


def _read_tracks(content: _JsonSection, left_out: LeftOut) -> tuple[ObjectTrack, ...]:
    tracks: dict[str, ObjectTrack] = {}
    for entry in content.sections("tracks", left_out):
        entry.only(TRACK_KEYS)
        with left_out.damaged("objects"):
            object_id = entry.get("object_id", str)
            if not object_id or object_id in tracks:
                raise LogError(f"{entry.where}: 'object_id' {object_id!r} is empty or used twice")
            tracks[object_id] = ObjectTrack(
                object_id=object_id,
                category=entry.get("category", str),
                size=entry.size("size"),
                trajectory=_read_trajectory(entry, left_out, "boxes"),
            )
    return tuple(tracks.values())


def _read_image_times(
    content: _JsonSection, rig: CameraRig, times_us: NDArray[np.int64], left_out: LeftOut
) -> dict[str, NDArray[np.int64]]:
    """Times of images by camera; the key and any camera are optional."""
    if "image_times_us" not in content.content:
        return {}
    section, found = content.section("image_times_us"), {}
    for name in section.content:
        with left_out.damaged("times"):
            where = f"{section.where}: {name}"
            if name not in rig.names:
                raise LogError(f"{where}: there is no usable camera of this name")
            given = check_frame_times(section.integers(name), where)
            if len(given) != len(times_us):
                raise LogError(f"{where}: {len(given)} times for {len(times_us)} frames")
            found[name] = given
    return found


def _image_files(path: Path, rig: CameraRig, frames: NDArray[np.intp]) -> dict[str, list[Path]]:
    images = {}
    for camera in rig:
        folder = path / "images" / camera.name
        suffix = next(
            (p.suffix for p in sorted(folder.glob("*")) if p.suffix.lower() in IMAGE_SUFFIXES),
            ".png",
        )
        images[camera.name] = [folder / f"{f:06d}{suffix}" for f in frames]
    return images


@dataclass(frozen=True, eq=False)
class _NativeSource:
    rig: CameraRig
    images: dict[str, list[Path]]
    sweeps: list[Path] | None

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return read_image(self.images[camera][frame])

    def check_image(self, camera: str, frame: int) -> None:
        lens = self.rig[camera]
        check_image_file(self.images[camera][frame], (lens.width, lens.height))

    def check_sweep(self, frame: int) -> int:
        return 0 if self.sweeps is None else _check_sweep(self.sweeps[frame])

    def lidar(self, frame: int) -> LidarSweep:
        if self.sweeps is None:
            return NO_SWEEP
        return _read_sweep(self.sweeps[frame])


def _check_sweep(path: Path) -> int:
    """Number of points according to the headers of a sweep's arrays."""
    with _sweep_archive(path) as archive:
        headers = read_headers(archive, max_bytes=MAX_SWEEP_BYTES)
    return _check_arrays(path, headers)


def _read_sweep(path: Path) -> LidarSweep:
    with _sweep_archive(path) as archive:
        parts = read_entries(archive, max_bytes=MAX_SWEEP_BYTES)
        arrays = {n: read_npy(data) for n, data in parts.items() if n.endswith(".npy")}
    _check_arrays(path, {name: (array.shape, array.dtype) for name, array in arrays.items()})
    points, intensity, offset_us, origin = (arrays[f"{name}.npy"] for name in SWEEP_SHAPES)
    for name in SWEEP_SHAPES:
        bad = int((~np.isfinite(arrays[f"{name}.npy"])).sum())
        if bad:
            raise LogError(
                f"{path}: {name} must be finite, but {bad} of its values are NaN or infinite; "
                "leave such points out"
            )
    if len(points) and np.abs(offset_us.astype(np.float64)).max() > MAX_OFFSET_US:
        raise LogError(
            f"{path}: offset_us ranges from {offset_us.min()} to {offset_us.max()}; it must be "
            "relative to the frame's time, in microseconds (the point's time minus the frame's)"
        )
    return LidarSweep(
        points=points.astype(np.float32),
        intensity=intensity.astype(np.float32),
        offset_us=offset_us.astype(np.int32),
        origin=origin.astype(np.float32),
    )


@contextmanager
def _sweep_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except FileNotFoundError as error:
        raise LogError(
            f"{path}: no such file; log.json says that every frame has a sweep"
        ) from error
    # Damaged files can raise almost any error.
    except Exception as error:
        cut = "; is the file cut off?" if isinstance(error, zipfile.BadZipFile) else ""
        raise LogError(
            f"{path}: expected an .npz with {', '.join(SWEEP_SHAPES)} ({error}){cut}"
        ) from error


def _check_arrays(path: Path, headers: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]) -> int:
    """Number of points in a sweep whose arrays have these shapes and types."""
    missing = [name for name in SWEEP_SHAPES if f"{name}.npy" not in headers]
    if missing:
        raise LogError(
            f"{path}: has no array {' and no '.join(map(repr, missing))}; a sweep has "
            f"{', '.join(SWEEP_SHAPES)}"
        )
    shape, _ = headers["points.npy"]
    count = shape[0] if shape else 0
    for name, expected in SWEEP_SHAPES.items():
        shape, dtype = headers[f"{name}.npy"]
        wanted = tuple(count if n < 0 else n for n in expected)
        if shape != wanted:
            raise LogError(f"{path}: {name} must be {wanted}, not {shape}")
        if dtype.kind not in "fiu":
            raise LogError(f"{path}: {name} must hold real numbers, not {dtype}")
    return count


# --- Writer --------------------------------------------------------------------------------------


def write_native_log(
    log: DrivingLog,
    path: str | Path,
    *,
    image_format: str = "png",
    on_progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write ``log`` to the folder ``path``, which is created atomically.

    Args:
        log: any log.
        path: a folder that does not exist yet, or an empty one.
        image_format: ``png`` (exact) or ``jpg`` (quality 95).
        on_progress: called with (done, total) after each image and each sweep.

    Returns:
        ``path``.

    Raises:
        LogError: the folder is not empty, or the log has a broken image or sweep.
    """
    target = Path(path)
    if image_format not in ("png", "jpg"):
        raise LogError(f"image_format must be 'png' or 'jpg', not {image_format!r}")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise LogError(f"{target}: is there already; name a folder that is new or empty")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        has_lidar = _write_frames(log, partial, image_format, on_progress)
        manifest = json.dumps(_manifest(log, has_lidar), indent=1)
        if log.lanes is not None:
            document = lane_document(log.lanes)
            (partial / LANES).write_text(document.model_dump_json(), encoding="utf-8")
        (partial / MANIFEST).write_text(manifest, encoding="utf-8")
        partial.chmod(0o755)
        os.replace(partial, target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return target


def _write_frames(
    log: DrivingLog,
    folder: Path,
    image_format: str,
    on_progress: Callable[[int, int], None] | None,
) -> bool:
    total, done, has_lidar = log.frame_count * (len(log.rig) + 1), 0, False
    for name in ("lidar", *(f"images/{camera}" for camera in log.rig.names)):
        (folder / name).mkdir(parents=True)
    for frame in range(log.frame_count):
        for camera in log.rig.names:
            if log.has_image(camera, frame):
                image = log.image(camera, frame)
                write_image(folder / "images" / camera / f"{frame:06d}.{image_format}", image)
            done = _report(done, total, on_progress)
        sweep = log.lidar(frame)
        has_lidar |= len(sweep.points) > 0
        if frame not in log.absent_sweeps:
            np.savez(
                folder / "lidar" / f"{frame:06d}.npz",
                points=sweep.points,
                intensity=sweep.intensity,
                offset_us=sweep.offset_us,
                origin=sweep.origin,
            )
        done = _report(done, total, on_progress)
    if not has_lidar:
        shutil.rmtree(folder / "lidar")
    return has_lidar


def _report(done: int, total: int, on_progress: Callable[[int, int], None] | None) -> int:
    if on_progress is not None:
        on_progress(done + 1, total)
    return done + 1


def _recorded(camera: Camera) -> dict[str, Any]:
    """The optics of the physical camera, if known."""
    if camera.recorded is None:
        return {}
    return {"recorded": OpticsPart.of(camera.recorded).model_dump(mode="json")}


def _manifest(log: DrivingLog, has_lidar: bool) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": log.name,
        "frame_times_us": log.frame_times_us.tolist(),
        "cameras": [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "T_vehicle_camera": camera.T_vehicle_camera.tolist(),
                **_recorded(camera),
            }
            for camera in log.rig
        ],
        "ego": {"size": list(log.ego_size), **_poses(log.ego)},
        "tracks": [
            {
                "object_id": track.object_id,
                "category": track.category,
                "size": list(track.size),
                **_poses(track.trajectory),
            }
            for track in log.tracks
        ],
        "lidar": has_lidar,
        "image_times_us": {
            name: log.image_times_us[name].tolist()
            for name in log.rig.names
            if name in log.image_times_us
        },
        "provenance": dict(log.provenance),
    }


def _poses(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "times_us": trajectory.times_us.tolist(),
        "positions": trajectory.positions.tolist(),
        "quaternions": trajectory.quaternions.tolist(),
    }
