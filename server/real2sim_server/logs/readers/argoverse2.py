"""Argoverse 2, sensor data set.

Source: the user guide and ``av2`` package of the data set (Wilson et al. 2021). Points are
egomotion-compensated to the time stamp of their sweep, which is its start; boxes refer to the same
time. The data set's ego frame is on the rear axle; here it is moved to the ground. Cameras run at
20 Hz by their own clock; a frame has the image nearest in time. Pixel centres are assumed at
integers, as in OpenCV's calibrations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, invert_transform, transform_from
from ...scene import CameraRig, SceneError, Trajectory
from ..driving_log import DrivingLog, LidarSweep, LogError, LoggedMap, ObjectTrack
from .common import FrameBox, Lens, TimedImages, build_tracks, match_images, select_sequence
from .files import ImageFiles, check_ego_covers, check_feather, check_frame_times, read_feather

AXLE_HEIGHT = 0.33
"""Height of the ego frame above the road [m], from the user guide."""

EGO_SIZE = (4.87, 1.85, 1.48)
"""Ford Fusion Hybrid without its roof sensors [m]."""

IMAGE_TOLERANCE_US = 60_000
LEFT_OUT = ("stereo_",)
"""Grey cameras with a quarter of the frame rate of the others."""

CATEGORIES = {
    "regular_vehicle": "car",
    "large_vehicle": "truck",
    "truck_cab": "truck",
    "box_truck": "truck",
    "vehicular_trailer": "truck",
    "school_bus": "bus",
    "articulated_bus": "bus",
    "official_signaler": "pedestrian",
    "bicyclist": "cyclist",
    "motorcyclist": "cyclist",
    "wheeled_rider": "cyclist",
}
POINT_COLUMNS = ("x", "y", "z", "intensity", "offset_ns")
QUATERNION = ("qw", "qx", "qy", "qz")
POSITION = ("tx_m", "ty_m", "tz_m")
SIZE = ("length_m", "width_m", "height_m")


class Argoverse2Reader:
    """Reads the folder of one log, or one of several in a folder."""

    name = "argoverse2"
    expects = (
        "[<log>/]city_SE3_egovehicle.feather, calibration/, annotations.feather, "
        "sensors/lidar/<ns>.feather, sensors/cameras/<camera>/<ns>.jpg"
    )

    def recognises(self, path: Path) -> bool:
        """Whether there is a ``city_SE3_egovehicle.feather``, here or one folder deeper."""
        return bool(_logs(path))

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The log ``sequence``; the only one by default.

        Every sweep is a frame; frames without images at both ends are dropped. Cameras without any
        image, and the stereo pair, are dropped and named in the provenance.

        Raises:
            LogError: see :class:`LogReader`.
        """
        logs = _logs(path)
        folder = logs[select_sequence(path, sorted(logs), sequence)]
        sweeps, times_us = _list_sweeps(folder / "sensors" / "lidar")
        city = _read_ego(folder / "city_SE3_egovehicle.feather")
        check_ego_covers(city, times_us, str(folder / "city_SE3_egovehicle.feather"))
        lenses, mounts = _read_calibration(folder / "calibration")
        images, without = _list_images(folder / "sensors" / "cameras", sorted(lenses))
        frames, files, image_times = np.arange(len(times_us)), {}, {}
        if images:
            matched = match_images(times_us, images, tolerance_us=IMAGE_TOLERANCE_US, where=folder)
            frames, files, image_times = matched.frames, matched.files, matched.times_us
        source = _Argoverse2Source(
            ImageFiles(files, {name: lenses[name] for name in files}),
            [sweeps[i] for i in frames],
            mounts["up_lidar"][:3, 3],
        )
        T_world_city = invert_transform(city.transform(int(times_us[frames[0]])))
        ego = city.moved(T_world_city)
        tracks, keys = _read_tracks(folder / "annotations.feather", ego)
        return DrivingLog(
            name=f"argoverse2_{folder.name}",
            rig=_rig(files, lenses, mounts),
            frame_times_us=times_us[frames],
            ego=ego,
            tracks=tracks,
            source=source,
            ego_size=EGO_SIZE,
            provenance={
                "dataset": "Argoverse 2 sensor",
                "sequence": folder.name,
                "licence": "CC BY-NC-SA 4.0 (Wilson et al. 2021)",
                "reader": self.name,
                "track_ids": keys,
                "cameras_without_images": without,
                "frames_without_all_images": len(times_us) - len(frames),
            },
            image_times_us=image_times,
            logged_map=_find_map(folder, T_world_city),
        )


def _find_map(folder: Path, T_world_city: Float) -> LoggedMap | None:
    maps = folder / "map"
    return LoggedMap(maps, T_world_city) if any(maps.glob("log_map_archive_*.json")) else None


def _logs(path: Path) -> dict[str, Path]:
    name = "city_SE3_egovehicle.feather"
    if (path / name).is_file():
        return {path.name: path}
    return {p.parent.name: p.parent for p in path.glob(f"*/{name}")}


def _stamps(folder: Path, suffix: str) -> dict[int, Path]:
    """Files by the time stamp [ns] that is their name."""
    files = {}
    for path in folder.glob(f"*{suffix}") if folder.is_dir() else ():
        if not path.stem.isdecimal():
            raise LogError(f"{path}: its name should be a time stamp [ns]")
        files[int(path.stem)] = path
    return dict(sorted(files.items()))


def _list_sweeps(folder: Path) -> tuple[list[Path], NDArray[np.int64]]:
    files = _stamps(folder, ".feather")
    if not files:
        raise LogError(f"{folder}: holds no sweeps <ns>.feather")
    times_us = np.array([ns // 1000 for ns in files], dtype=np.int64)
    return list(files.values()), check_frame_times(times_us, str(folder))


def _list_images(folder: Path, cameras: Sequence[str]) -> tuple[dict[str, TimedImages], list[str]]:
    found, without = {}, []
    for name in cameras:
        files = {} if name.startswith(LEFT_OUT) else _stamps(folder / name, ".jpg")
        if files:
            times = np.array([ns // 1000 for ns in files], dtype=np.int64)
            found[name] = TimedImages(list(files.values()), times)
        else:
            without.append(name)
    return found, without


def _read_ego(path: Path) -> Trajectory:
    """``T_city_vehicle``; the vehicle frame is on the ground."""
    table = read_feather(path, ["timestamp_ns", *QUATERNION, *POSITION])
    order = np.argsort(table["timestamp_ns"], kind="stable")
    times_us, kept = np.unique(table["timestamp_ns"][order] // 1000, return_index=True)
    try:
        return Trajectory.from_transforms(
            times_us, _transforms(table, path)[order][kept] @ _shift(-AXLE_HEIGHT)
        )
    except SceneError as error:
        raise LogError(f"{path}: {error}") from error


def _transforms(table: Mapping[str, NDArray[Any]], path: Path) -> Float:
    positions = np.stack([table[n] for n in POSITION], axis=1).astype(np.float64)
    quaternions = np.stack([table[n] for n in QUATERNION], axis=1)
    norms = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1) | ~(np.abs(norms - 1) < 1e-2))
    if len(bad):
        raise LogError(
            f"{path} row {bad[0]}: the pose is not finite, or its quaternion not of unit length"
        )
    return transform_from(positions, quaternions)


def _shift(z: float) -> Float:
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def _read_calibration(folder: Path) -> tuple[dict[str, Lens], dict[str, Float]]:
    """Lenses, and ``T_vehicle_sensor`` of all sensors."""
    path = folder / "egovehicle_SE3_sensor.feather"
    table = read_feather(path, ["sensor_name", *QUATERNION, *POSITION])
    poses = _shift(AXLE_HEIGHT) @ _transforms(table, path)
    mounts = {str(n): pose for n, pose in zip(table["sensor_name"], poses, strict=True)}
    path = folder / "intrinsics.feather"
    names = ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px"]
    table = read_feather(path, ["sensor_name", *names])
    lenses = {}
    for i, name in enumerate(table["sensor_name"]):
        fx, fy, cx, cy, k1, k2, k3, width, height = (float(table[n][i]) for n in names)
        k = np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]])
        lenses[str(name)] = Lens(int(width), int(height), k, (k1, k2, 0.0, 0.0, k3))
    for name in (*lenses, "up_lidar"):
        if name not in mounts:
            raise LogError(f"{folder / 'egovehicle_SE3_sensor.feather'}: has no sensor {name!r}")
    return lenses, mounts


def _rig(
    cameras: Mapping[str, object], lenses: Mapping[str, Lens], mounts: Mapping[str, Float]
) -> CameraRig:
    try:
        return CameraRig(tuple(lenses[n].camera(n, mounts[n]) for n in cameras))
    except SceneError as error:
        raise LogError(f"calibration: {error}") from error


def _read_tracks(path: Path, ego: Trajectory) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    """Tracks over all annotated instants, also those without a sweep."""
    if not path.exists():
        return (), {}
    table = read_feather(
        path, ["timestamp_ns", "track_uuid", "category", *SIZE, *QUATERNION, *POSITION]
    )
    times_us = (table["timestamp_ns"] // 1000).tolist()
    in_vehicle = _shift(AXLE_HEIGHT) @ _transforms(table, path)
    vehicle = {t: ego.transform(t) for t in set(times_us) if ego.covers(t)}
    sizes = np.stack([table[n] for n in SIZE], axis=1).tolist()
    boxes = []
    for row, time_us in enumerate(times_us):
        where = f"{path} row {row}"
        if time_us not in vehicle:
            raise LogError(f"{where}: there is no ego pose at {time_us} us")
        category = str(table["category"][row]).lower()
        length, width, height = sizes[row]
        boxes.append(
            FrameBox(
                key=str(table["track_uuid"][row]),
                category=CATEGORIES.get(category, category),
                size=(length, width, height),
                time_us=time_us,
                T_world_object=vehicle[time_us] @ in_vehicle[row],
                where=where,
            )
        )
    return build_tracks(boxes)


@dataclass(frozen=True, eq=False)
class _Argoverse2Source:
    images: ImageFiles
    sweeps: Sequence[Path]
    lidar_position: Float

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return self.images.read(camera, frame)

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError if the image is truncated or has a wrong size."""
        self.images.check(camera, frame)

    def check_sweep(self, frame: int) -> None:
        """See :class:`ChecksFiles`."""
        check_feather(self.sweeps[frame], POINT_COLUMNS)

    def lidar(self, frame: int) -> LidarSweep:
        path = self.sweeps[frame]
        table = read_feather(path, POINT_COLUMNS)
        points = np.stack([table[n] for n in "xyz"], axis=1).astype(np.float64)
        finite = np.isfinite(points).all(axis=1)
        points[:, 2] += AXLE_HEIGHT
        return LidarSweep(
            points=points[finite].astype(np.float32),
            intensity=(table["intensity"][finite] / 255).astype(np.float32),
            offset_us=np.round(table["offset_ns"][finite] / 1000).astype(np.int32),
            origin=self.lidar_position.astype(np.float32),
        )
