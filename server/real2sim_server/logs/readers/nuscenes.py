"""nuScenes, full data set or mini.

Source: ``docs/schema_nuscenes.md`` of the data set's development kit. Cameras run at 12 Hz and the
LiDAR at 20 Hz; a frame is an image of CAM_FRONT with the images and the sweep nearest in time.
Sweeps are motion-compensated to their time stamp, which is their end. Boxes exist at 2 Hz and
tracks interpolate them. Pixel centres are assumed at integers.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform, transform_from
from ...scene import CameraRig, Trajectory
from ...scene.errors import LeftOut
from ..driving_log import NO_SWEEP, DrivingLog, LidarSweep, LogError, LoggedMap, ObjectTrack
from .common import (
    FrameBox,
    Lens,
    TimedImages,
    build_tracks,
    covered_frames,
    match_images,
    select_sequence,
)
from .files import ImageFiles, Tables, count_rows, read_rows

LIDAR, CAMERA, FRONT = "LIDAR_TOP", "CAM_", "cam_front"
TOLERANCE_US = 60_000
MAX_GAP = 20
"""Maximum number of frames into which a gap is divided."""
MAX_TIME_US = 1e18
HALF_SWEEP_US = 25_000
COLUMNS = 5
"""Columns of a sweep's points: x, y, z, intensity, ring."""
EGO_SIZE = (4.084, 1.73, 1.562)
"""Renault Zoe [m]."""

CATEGORIES = (
    ("vehicle.car", "car"),
    ("vehicle.emergency", "car"),
    ("vehicle.truck", "truck"),
    ("vehicle.trailer", "truck"),
    ("vehicle.construction", "truck"),
    ("vehicle.bus", "bus"),
    ("vehicle.bicycle", "cyclist"),
    ("vehicle.motorcycle", "cyclist"),
    ("human.pedestrian", "pedestrian"),
)
TABLES = (
    "scene", "sample", "sample_data", "sample_annotation", "instance", "category",
    "calibrated_sensor", "sensor", "ego_pose",
)  # fmt: skip


class NuScenesReader:
    """Reads one scene of ``v1.0-*``."""

    name = "nuscenes"
    expects = "v1.0-*/scene.json and the other tables, samples/, sweeps/"

    def recognises(self, path: Path) -> bool:
        """Whether there is a ``v1.0-*/scene.json``."""
        return any(path.glob("v1.0-*/scene.json"))

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The scene named ``sequence``; the only one by default.

        Raises:
            LogError: see :class:`LogReader`.
        """
        folder = sorted(p.parent for p in path.glob("v1.0-*/scene.json"))[0]
        left_out = LeftOut()
        tables = Tables(folder, TABLES, left_out)
        scenes = {str(s["name"]): s for s in tables.rows("scene") if "name" in s}
        name = select_sequence(folder / "scene.json", sorted(scenes), sequence)
        samples = _samples(tables, scenes[name]["token"], left_out)
        recordings = _recordings(tables, samples, left_out)
        lenses, mounts = _calibration(tables, recordings, left_out)
        timed = {c: TimedImages(recordings[c].files(path), recordings[c].times_us) for c in mounts}
        if not lenses:
            raise LogError(f"{tables.path('sample_data')}: {name!r} has no usable camera")
        reference = max(lenses, key=lambda c: (c == FRONT, len(timed[c].times_us)))
        given = _without_gaps(timed[reference].times_us)
        ego = _ego(tables, recordings.values(), given, left_out)
        frames = covered_frames(ego.in_log, given, left_out, str(tables.path("ego_pose")))
        times_us = given[frames]
        matched = match_images(
            times_us, timed, tolerance_us=TOLERANCE_US, left_out=left_out, where=folder
        )
        tracks, keys = _tracks(tables, samples, ego.to_log, left_out)
        return DrivingLog(
            name=f"nuscenes_{name}",
            rig=_rig(lenses, mounts),
            frame_times_us=times_us,
            ego=ego.in_log,
            tracks=tracks,
            source=_NuScenesSource(
                images=ImageFiles(matched.files, lenses),
                sweeps=matched.files.get(LIDAR),
                sweep_times_us=matched.times_us.get(LIDAR, times_us),
                frame_times_us=times_us,
                T_vehicle_lidar=mounts.get(LIDAR, np.eye(4)),
                ego=ego.in_log,
            ),
            ego_size=EGO_SIZE,
            provenance={
                "dataset": f"nuScenes {folder.name}",
                "sequence": name,
                "licence": "CC BY-NC-SA 4.0 (Caesar et al. 2020)",
                "reader": self.name,
                "track_ids": keys,
                "T_world_dataset": ego.to_log.tolist(),
            },
            image_times_us={c: matched.times_us[c] for c in lenses},
            absent_images=frozenset((c, i) for c, i in matched.absent if c != LIDAR),
            absent_sweeps=frozenset(i for c, i in matched.absent if c == LIDAR),
            left_out=left_out.told(),
            logged_map=_find_map(path, folder, scenes[name], ego.to_log),
        )


def _without_gaps(times_us: NDArray[np.int64]) -> NDArray[np.int64]:
    """Times of images, and evenly spaced ones where images are missing in between."""
    steps = np.diff(times_us)
    counts = np.rint(steps / np.median(steps)).astype(int) if len(steps) else steps
    filled = [times_us[:1]]
    for time_us, step, count in zip(times_us[:-1], steps, np.clip(counts, 1, None), strict=True):
        filled.append(time_us + step * np.arange(1, min(count, MAX_GAP) + 1) // min(count, MAX_GAP))
    return np.concatenate(filled)


def _find_map(
    root: Path, folder: Path, scene: Mapping[str, Any], T_world_map: Float
) -> LoggedMap | None:
    """The map expansion of a scene's location, if it was unpacked next to the tables."""
    try:
        log = Tables(folder, ("log",), LeftOut()).row("log", str(scene["log_token"]))
        name = Path(str(log["location"])).name
    except LogError:
        return None
    path = root / "maps" / "expansion" / f"{name}.json"
    return LoggedMap(path, T_world_map) if path.is_file() else None


def _samples(tables: Tables, scene: str, left_out: LeftOut) -> dict[str, int]:
    """Times of the samples of a scene [us], by token."""
    times = {}
    for row in tables.rows("sample"):
        with left_out.damaged("samples"):
            if row["scene_token"] == scene:
                times[row["token"]] = _time_us(tables, "sample", row)
    return times


def _time_us(tables: Tables, table: str, row: Mapping[str, Any]) -> int:
    value = row["timestamp"]
    if not isinstance(value, int | float) or not abs(value) < MAX_TIME_US:
        raise LogError(f"{tables.path(table)}: {row['token']!r}: timestamp {value!r} is not a time")
    return int(value)


@dataclass(frozen=True, eq=False)
class _Recording:
    """Rows of ``sample_data`` of one sensor, by time."""

    rows: Sequence[Mapping[str, Any]]
    times_us: NDArray[np.int64]

    def files(self, root: Path) -> list[Path]:
        return [root / str(row["filename"]).replace("\\", "/") for row in self.rows]


def _recordings(
    tables: Tables, samples: Mapping[str, int], left_out: LeftOut
) -> dict[str, _Recording]:
    known = {row["token"] for row in tables.rows("sample")}
    found: dict[str, dict[int, Mapping[str, Any]]] = defaultdict(dict)
    for row in tables.rows("sample_data"):
        with left_out.damaged("recordings"):
            where = f"{tables.path('sample_data')}: {row['token']!r}"
            if row["sample_token"] not in known:
                raise LogError(f"{where}: has no sample {row['sample_token']!r}")
            if row["sample_token"] not in samples:
                continue
            mount = tables.row("calibrated_sensor", row["calibrated_sensor_token"])
            channel = str(tables.row("sensor", mount["sensor_token"])["channel"])
            channel = channel.lower() if channel.startswith(CAMERA) else channel
            time_us, _ = _time_us(tables, "sample_data", row), row["filename"]
            if time_us in found[channel]:
                raise LogError(f"{where}: {channel} has two recordings at {time_us} us")
            found[channel][time_us] = row
    return {
        channel: _Recording(
            [by_time[t] for t in sorted(by_time)], np.array(sorted(by_time), dtype=np.int64)
        )
        for channel, by_time in sorted(found.items())
        if by_time
    }


def _calibration(
    tables: Tables, recordings: Mapping[str, _Recording], left_out: LeftOut
) -> tuple[dict[str, Lens], dict[str, Float]]:
    """Lenses by camera, and ``T_vehicle_sensor`` [4, 4] of cameras and LiDAR."""
    lenses, mounts = {}, {}
    for channel, recording in recordings.items():
        is_camera = channel.startswith(CAMERA.lower())
        if not is_camera and channel != LIDAR:
            continue
        row = recording.rows[0]
        mount = tables.row("calibrated_sensor", row["calibrated_sensor_token"])
        with left_out.damaged("cameras" if is_camera else "LiDARs"):
            pose = _pose(tables, "calibrated_sensor", mount)
            if is_camera:
                lens = _lens(tables, row, mount)
                lens.camera(channel, pose)
                lenses[channel] = lens
            mounts[channel] = pose
    return lenses, mounts


def _lens(tables: Tables, row: Mapping[str, Any], mount: Mapping[str, Any]) -> Lens:
    where = f"{tables.path('calibrated_sensor')}: {mount['token']!r}"
    try:
        k = np.array(mount["camera_intrinsic"], dtype=np.float64)
        width, height = int(row["width"]), int(row["height"])
    except (TypeError, ValueError) as error:
        raise LogError(
            f"{where}: its intrinsics or image size are not numbers ({error})"
        ) from error
    if k.shape != (3, 3) or not np.isfinite(k).all() or min(k[0, 0], k[1, 1]) <= 0:
        raise LogError(f"{where}: camera_intrinsic must be a 3x3 matrix, not {k.tolist()}")
    if min(width, height) < 1:
        raise LogError(f"{where}: its images are {width}x{height}")
    k[:2, 2] += 0.5
    return Lens(width, height, k)


def _pose(tables: Tables, table: str, row: Mapping[str, Any]) -> Float:
    where = f"{tables.path(table)}: {row['token']!r}"
    try:
        position = np.array(row["translation"], dtype=np.float64)
        quaternion = np.array(row["rotation"], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise LogError(f"{where}: the pose is not numeric ({error})") from error
    length = np.linalg.norm(quaternion)
    if position.shape != (3,) or quaternion.shape != (4,) or not abs(length - 1) < 1e-2:
        raise LogError(f"{where}: the pose is not rigid")
    if not np.isfinite(position).all():
        raise LogError(f"{where}: the pose is not finite")
    return transform_from(position, quaternion)


def _rig(lenses: Mapping[str, Lens], mounts: Mapping[str, Float]) -> CameraRig:
    return CameraRig(tuple(lens.camera(c, mounts[c]) for c, lens in lenses.items()))


@dataclass(frozen=True, eq=False)
class _Ego:
    """The path in the log's world, and the transform from nuScenes' map to it."""

    in_log: Trajectory
    to_log: Float


def _ego(
    tables: Tables,
    recordings: Iterable[_Recording],
    times_us: NDArray[np.int64],
    left_out: LeftOut,
) -> _Ego:
    """The ego path through the poses of all recordings of the scene."""
    poses: dict[int, Float] = {}
    for recording in recordings:
        for row in recording.rows:
            with left_out.damaged("poses"):
                pose = tables.row("ego_pose", str(row["ego_pose_token"]))
                time_us = _time_us(tables, "ego_pose", pose)
                if time_us not in poses:
                    poses[time_us] = _pose(tables, "ego_pose", pose)
    if not poses:
        raise LogError(f"{tables.path('ego_pose')}: has no pose of this scene")
    times = sorted(poses)
    path = Trajectory.from_transforms(times, np.array([poses[t] for t in times]))
    covered = times_us[(times_us >= path.start_us) & (times_us <= path.end_us)]
    to_log = invert_transform(path.transform(int(covered[0]) if len(covered) else path.start_us))
    return _Ego(path.moved(to_log), to_log)


def _tracks(
    tables: Tables, samples: Mapping[str, int], to_log: Float, left_out: LeftOut
) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    known = {row["token"] for row in tables.rows("sample")}
    boxes = []
    for row in tables.rows("sample_annotation"):
        with left_out.damaged("boxes"):
            where = f"{tables.path('sample_annotation')}: {row['token']!r}"
            if row["sample_token"] not in known:
                raise LogError(f"{where}: has no sample {row['sample_token']!r}")
            if row["sample_token"] not in samples:
                continue
            instance = tables.row("instance", row["instance_token"])
            name = str(tables.row("category", instance["category_token"])["name"])
            try:
                width, length, height = (float(v) for v in row["size"])
            except (TypeError, ValueError) as error:
                raise LogError(f"{where}: size must be three numbers ({error})") from error
            boxes.append(
                FrameBox(
                    key=str(row["instance_token"]),
                    category=_category(name),
                    size=(length, width, height),
                    time_us=samples[row["sample_token"]],
                    T_world_object=to_log @ _pose(tables, "sample_annotation", row),
                    where=where,
                )
            )
    return build_tracks(boxes, left_out)


def _category(name: str) -> str:
    for prefix, category in CATEGORIES:
        if name.startswith(prefix):
            return category
    return name.rsplit(".", maxsplit=1)[-1]


@dataclass(frozen=True, eq=False)
class _NuScenesSource:
    images: ImageFiles
    sweeps: Sequence[Path] | None
    sweep_times_us: NDArray[np.int64]
    frame_times_us: NDArray[np.int64]
    T_vehicle_lidar: Float
    ego: Trajectory

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return self.images.read(camera, frame)

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError if the image is truncated or has a wrong size."""
        self.images.check(camera, frame)

    def check_sweep(self, frame: int) -> int:
        """See :class:`ChecksFiles`."""
        return 0 if self.sweeps is None else count_rows(self.sweeps[frame], COLUMNS)

    def lidar(self, frame: int) -> LidarSweep:
        if self.sweeps is None:
            return NO_SWEEP
        rows = read_rows(self.sweeps[frame], COLUMNS)
        rows = rows[np.isfinite(rows[:, :4]).all(axis=1)]
        frame_us, sweep_us = int(self.frame_times_us[frame]), int(self.sweep_times_us[frame])
        sweep_us = min(max(sweep_us, self.ego.start_us), self.ego.end_us)
        moved = invert_transform(self.ego.transform(frame_us)) @ self.ego.transform(sweep_us)
        mount = moved @ self.T_vehicle_lidar
        offset = np.full(len(rows), sweep_us - HALF_SWEEP_US - frame_us, dtype=np.int32)
        return LidarSweep(
            points=apply_transform(mount, rows[:, :3].astype(np.float64)).astype(np.float32),
            intensity=np.clip(rows[:, 3] / 255, 0, 1),
            offset_us=offset,
            origin=mount[:3, 3].astype(np.float32),
        )
