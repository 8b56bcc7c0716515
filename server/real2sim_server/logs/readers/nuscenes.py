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
from ...scene import CameraRig, SceneError, Trajectory
from ..driving_log import DrivingLog, LidarSweep, LogError, LoggedMap, ObjectTrack
from .common import (
    FrameBox,
    Lens,
    MatchedImages,
    TimedImages,
    build_tracks,
    match_images,
    select_sequence,
)
from .files import ImageFiles, Tables, check_ego_covers, check_frame_times, count_rows, read_rows

LIDAR, FRONT = "LIDAR_TOP", "CAM_FRONT"
TOLERANCE_US = 60_000
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
        tables = Tables(folder, TABLES)
        scenes = {str(s["name"]): str(s["token"]) for s in tables.rows("scene")}
        name = select_sequence(folder / "scene.json", sorted(scenes), sequence)
        samples = {s["token"] for s in tables.rows("sample") if s["scene_token"] == scenes[name]}
        recordings = _recordings(tables, samples)
        cameras = {c: r for c, r in recordings.items() if c.startswith("CAM_")}
        if FRONT not in cameras or LIDAR not in recordings:
            raise LogError(f"{tables.path('sample_data')}: {name!r} needs {FRONT} and {LIDAR}")
        front, matched = _match(path, folder, recordings)
        times_us = front[matched.frames]
        sweeps, sweep_times = matched.files.pop(LIDAR), matched.times_us.pop(LIDAR)
        ego = _ego(tables, recordings.values(), int(times_us[0]))
        check_ego_covers(ego.in_log, times_us, str(tables.path("ego_pose")))
        lenses = {c.lower(): _lens(tables, r, c) for c, r in cameras.items()}
        images = ImageFiles(matched.files, lenses)
        tracks, keys = _tracks(tables, samples, ego.to_log)
        return DrivingLog(
            name=f"nuscenes_{name}",
            rig=_rig(tables, cameras, lenses),
            frame_times_us=times_us,
            ego=ego.in_log,
            tracks=tracks,
            source=_NuScenesSource(
                images=images,
                sweeps=sweeps,
                sweep_times_us=sweep_times,
                frame_times_us=times_us,
                T_vehicle_lidar=_mount(tables, recordings[LIDAR]),
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
                "frames_without_all_images": len(front) - len(times_us),
            },
            image_times_us=matched.times_us,
            logged_map=_find_map(path, folder, tables.row("scene", scenes[name]), ego.to_log),
        )


def _find_map(
    root: Path, folder: Path, scene: Mapping[str, Any], T_world_map: Float
) -> LoggedMap | None:
    """The map expansion of a scene's location, if it was unpacked next to the tables."""
    if not (folder / "log.json").is_file():
        return None
    log = Tables(folder, ("log",)).row("log", str(scene["log_token"]))
    path = root / "maps" / "expansion" / f"{Path(str(log['location'])).name}.json"
    return LoggedMap(path, T_world_map) if path.is_file() else None


def _match(
    root: Path, folder: Path, recordings: Mapping[str, _Recording]
) -> tuple[NDArray[np.int64], MatchedImages]:
    """Times of all images of the front camera, and the images and sweeps nearest to them."""
    front = check_frame_times(recordings[FRONT].times_us, f"{folder / 'sample_data.json'}")
    timed = {
        (c if c == LIDAR else c.lower()): TimedImages(r.files(root), r.times_us)
        for c, r in recordings.items()
        if c == LIDAR or c.startswith("CAM_")
    }
    return front, match_images(front, timed, tolerance_us=TOLERANCE_US, where=folder)


@dataclass(frozen=True, eq=False)
class _Recording:
    """Rows of ``sample_data`` of one sensor, by time."""

    rows: Sequence[Mapping[str, Any]]

    @property
    def times_us(self) -> NDArray[np.int64]:
        return np.array([row["timestamp"] for row in self.rows], dtype=np.int64)

    def files(self, root: Path) -> list[Path]:
        return [root / row["filename"] for row in self.rows]


def _recordings(tables: Tables, samples: set[str]) -> dict[str, _Recording]:
    channels = {}
    for sensor in tables.rows("calibrated_sensor"):
        channels[sensor["token"]] = tables.row("sensor", sensor["sensor_token"])["channel"]
    rows: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for row in tables.rows("sample_data"):
        if row["sample_token"] in samples:
            sensor = tables.row("calibrated_sensor", row["calibrated_sensor_token"])
            rows[channels[sensor["token"]]].append(row)
    return {
        channel: _Recording(sorted(found, key=lambda r: int(r["timestamp"])))
        for channel, found in sorted(rows.items())
    }


def _lens(tables: Tables, recording: _Recording, channel: str) -> Lens:
    row = recording.rows[0]
    given = tables.row("calibrated_sensor", row["calibrated_sensor_token"])["camera_intrinsic"]
    k = np.array(given, dtype=np.float64)
    if k.shape != (3, 3) or not np.isfinite(k).all():
        raise LogError(f"{tables.path('calibrated_sensor')}: {channel} needs a 3x3 matrix")
    k[:2, 2] += 0.5
    return Lens(int(row["width"]), int(row["height"]), k)


def _mount(tables: Tables, recording: _Recording) -> Float:
    """``T_vehicle_sensor`` [4, 4]."""
    token = recording.rows[0]["calibrated_sensor_token"]
    return _pose(tables, "calibrated_sensor", tables.row("calibrated_sensor", token))


def _pose(tables: Tables, table: str, row: Mapping[str, Any]) -> Float:
    position = np.array(row["translation"], dtype=np.float64)
    quaternion = np.array(row["rotation"], dtype=np.float64)
    length = np.linalg.norm(quaternion)
    if position.shape != (3,) or quaternion.shape != (4,) or not abs(length - 1) < 1e-2:
        raise LogError(f"{tables.path(table)}: {row['token']!r}: the pose is not rigid")
    if not np.isfinite(position).all():
        raise LogError(f"{tables.path(table)}: {row['token']!r}: the pose is not finite")
    return transform_from(position, quaternion)


def _rig(
    tables: Tables, cameras: Mapping[str, _Recording], lenses: Mapping[str, Lens]
) -> CameraRig:
    try:
        return CameraRig(
            tuple(
                lens.camera(c.lower(), _mount(tables, r))
                for (c, r), lens in zip(cameras.items(), lenses.values(), strict=True)
            )
        )
    except SceneError as error:
        raise LogError(f"{tables.path('calibrated_sensor')}: {error}") from error


@dataclass(frozen=True, eq=False)
class _Ego:
    """The path in the log's world, and the transform from nuScenes' map to it."""

    in_log: Trajectory
    to_log: Float


def _ego(tables: Tables, recordings: Iterable[_Recording], start_us: int) -> _Ego:
    """The ego path through the poses of all recordings of the scene."""
    where = tables.path("ego_pose")
    poses: dict[int, Mapping[str, Any]] = {}
    for recording in recordings:
        for row in recording.rows:
            pose = tables.row("ego_pose", row["ego_pose_token"])
            poses.setdefault(int(pose["timestamp"]), pose)
    times = sorted(poses)
    try:
        path = Trajectory.from_transforms(
            times, np.array([_pose(tables, "ego_pose", poses[t]) for t in times])
        )
    except SceneError as error:
        raise LogError(f"{where}: {error}") from error
    check_ego_covers(path, np.array([start_us]), str(where))
    to_log = invert_transform(path.transform(start_us))
    return _Ego(path.moved(to_log), to_log)


def _tracks(
    tables: Tables, samples: set[str], to_log: Float
) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    times = {s["token"]: int(s["timestamp"]) for s in tables.rows("sample")}
    boxes = []
    for row in tables.rows("sample_annotation"):
        if row["sample_token"] not in samples:
            continue
        instance = tables.row("instance", row["instance_token"])
        name = str(tables.row("category", instance["category_token"])["name"])
        width, length, height = (float(v) for v in row["size"])
        boxes.append(
            FrameBox(
                key=str(row["instance_token"]),
                category=_category(name),
                size=(length, width, height),
                time_us=times[row["sample_token"]],
                T_world_object=to_log @ _pose(tables, "sample_annotation", row),
                where=f"{tables.path('sample_annotation')}: {row['token']!r}",
            )
        )
    return build_tracks(boxes)


def _category(name: str) -> str:
    for prefix, category in CATEGORIES:
        if name.startswith(prefix):
            return category
    return name.rsplit(".", maxsplit=1)[-1]


@dataclass(frozen=True, eq=False)
class _NuScenesSource:
    images: ImageFiles
    sweeps: Sequence[Path]
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
        return count_rows(self.sweeps[frame], COLUMNS)

    def lidar(self, frame: int) -> LidarSweep:
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
