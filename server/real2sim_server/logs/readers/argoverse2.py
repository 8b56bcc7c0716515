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
from ...scene import CameraRig, Trajectory
from ...scene.errors import LeftOut
from ..driving_log import DrivingLog, LidarSweep, LogError, LoggedMap, ObjectTrack
from .common import (
    FrameBox,
    Lens,
    TimedImages,
    build_tracks,
    covered_frames,
    match_images,
    select_sequence,
)
from .files import ImageFiles, check_feather, read_feather

AXLE_HEIGHT = 0.33
"""Height of the ego frame above the road [m], from the user guide."""

EGO_SIZE = (4.87, 1.85, 1.48)
"""Ford Fusion Hybrid without its roof sensors [m]."""

IMAGE_TOLERANCE_US = 60_000
MAX_DIGITS = 18
NOT_READ = ("stereo_",)
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

        Every sweep is a frame. Cameras without any image are left out; the stereo pair is not read.

        Raises:
            LogError: see :class:`LogReader`.
        """
        logs = _logs(path)
        folder = logs[select_sequence(path, sorted(logs), sequence)]
        left_out = LeftOut()
        sweeps = _recordings(folder / "sensors" / "lidar", ".feather", left_out)
        if sweeps is None:
            raise LogError(f"{folder / 'sensors' / 'lidar'}: holds no sweeps <ns>.feather")
        where = folder / "city_SE3_egovehicle.feather"
        city = _read_ego(where, left_out)
        lenses, mounts = _read_calibration(folder / "calibration", left_out)
        images = {}
        for name in sorted(lenses):
            if name.startswith(NOT_READ):
                continue
            found = _recordings(folder / "sensors" / "cameras" / name, ".jpg", left_out)
            if found is not None:
                images[name] = found
            else:
                left_out["cameras"].append(f"camera {name!r}: has no images")
        frames = covered_frames(city, sweeps.times_us, left_out, str(where))
        times_us = sweeps.times_us[frames]
        matched = match_images(
            times_us, images, tolerance_us=IMAGE_TOLERANCE_US, left_out=left_out, where=folder
        )
        has_lidar = "up_lidar" in mounts
        source = _Argoverse2Source(
            ImageFiles(matched.files, lenses),
            [sweeps.files[k] for k in frames],
            mounts["up_lidar"][:3, 3] if has_lidar else np.zeros(3),
        )
        T_world_city = invert_transform(city.transform(int(times_us[0])))
        ego = city.moved(T_world_city)
        tracks, keys = _read_tracks(folder / "annotations.feather", ego, sweeps.times_us, left_out)
        return DrivingLog(
            name=f"argoverse2_{folder.name}",
            rig=CameraRig(tuple(lenses[n].camera(n, mounts[n]) for n in images)),
            frame_times_us=times_us,
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
            },
            image_times_us=matched.times_us,
            absent_images=matched.absent,
            absent_sweeps=frozenset() if has_lidar else frozenset(range(len(frames))),
            left_out=left_out.told(),
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


def _recordings(folder: Path, suffix: str, left_out: LeftOut) -> TimedImages | None:
    """Files by the time stamp [ns] that is their name; None without any."""
    files = {}
    for path in folder.glob(f"*{suffix}") if folder.is_dir() else ():
        if path.stem.isdecimal() and len(path.stem) <= MAX_DIGITS:
            files[int(path.stem) // 1000] = path
        else:
            left_out["files"].append(f"{path}: its name should be a time stamp [ns]")
    times_us = sorted(files)
    if not times_us:
        return None
    return TimedImages([files[t] for t in times_us], np.array(times_us, dtype=np.int64))


def _read_ego(path: Path, left_out: LeftOut) -> Trajectory:
    """``T_city_vehicle``; the vehicle frame is on the ground."""
    table = read_feather(path, ["timestamp_ns", *QUATERNION, *POSITION], left_out, kind="poses")
    poses, good = _transforms(table, path, "poses", left_out)
    times_us = (table["timestamp_ns"] // 1000)[good]
    times_us, kept = np.unique(times_us, return_index=True)
    if len(times_us) == 0:
        raise LogError(f"{path}: holds no usable pose")
    return Trajectory.from_transforms(times_us, poses[good][kept] @ _shift(-AXLE_HEIGHT))


def _transforms(
    table: Mapping[str, NDArray[Any]], path: Path, kind: str, left_out: LeftOut
) -> tuple[Float, NDArray[np.intp]]:
    """Poses [N, 4, 4], and the rows of the usable ones; the others are left out."""
    positions = np.stack([table[n] for n in POSITION], axis=1).astype(np.float64)
    quaternions = np.stack([table[n] for n in QUATERNION], axis=1).astype(np.float64)
    norms = np.linalg.norm(quaternions, axis=1)
    bad = ~np.isfinite(positions).all(axis=1) | ~(np.abs(norms - 1) < 1e-2)
    for row in np.flatnonzero(bad):
        left_out[kind].append(
            f"{path} row {row}: the pose is not finite, or its quaternion not of unit length"
        )
    quaternions[bad], positions[bad] = (1, 0, 0, 0), 0
    return transform_from(positions, quaternions), np.flatnonzero(~bad)


def _shift(z: float) -> Float:
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def _read_calibration(folder: Path, left_out: LeftOut) -> tuple[dict[str, Lens], dict[str, Float]]:
    """Lenses, and ``T_vehicle_sensor`` of all sensors."""
    poses_path = folder / "egovehicle_SE3_sensor.feather"
    table = read_feather(poses_path, ["sensor_name", *QUATERNION, *POSITION], left_out)
    poses, good = _transforms(table, poses_path, "calibrations", left_out)
    mounts = {str(table["sensor_name"][i]): _shift(AXLE_HEIGHT) @ poses[i] for i in good}
    path = folder / "intrinsics.feather"
    names = ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px"]
    table = read_feather(path, ["sensor_name", *names], left_out, kind="cameras")
    lenses = {}
    for i, key in enumerate(table["sensor_name"]):
        name = str(key)
        with left_out.damaged("cameras"):
            values = [float(table[n][i]) for n in names]
            fx, fy, cx, cy, k1, k2, k3, width, height = values
            if not np.isfinite(values).all() or min(fx, fy, width, height) <= 0:
                raise LogError(f"{path}: camera {name!r} has the intrinsics {values}")
            if name not in mounts:
                raise LogError(f"{poses_path}: has no pose of camera {name!r}")
            k = np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]])
            lens = Lens(int(width), int(height), k, (k1, k2, 0.0, 0.0, k3))
            lens.camera(name, mounts[name])
            lenses[name] = lens
    if "up_lidar" not in mounts:
        left_out["LiDARs"].append(f"{poses_path}: has no pose of 'up_lidar'")
    return lenses, mounts


def _read_tracks(
    path: Path, ego: Trajectory, sweeps_us: NDArray[np.int64], left_out: LeftOut
) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    """Tracks over all annotated instants, also those without a sweep."""
    if not path.exists():
        return (), {}
    names = ["timestamp_ns", "track_uuid", "category", *SIZE, *QUATERNION, *POSITION]
    table = read_feather(path, names, left_out, kind="boxes")
    times_us = (table["timestamp_ns"] // 1000).tolist()
    poses, good = _transforms(table, path, "boxes", left_out)
    in_vehicle = _shift(AXLE_HEIGHT) @ poses
    inside = [t for t in set(times_us) if sweeps_us[0] < t < sweeps_us[-1]]
    for t_us in sorted(set(inside) - set(sweeps_us.tolist())):
        left_out["frames"].append(f"{path}: has boxes at {t_us} us, when there is no sweep")
    vehicle = {t: ego.transform(t) for t in set(times_us) if ego.covers(t)}
    sizes = np.stack([table[n] for n in SIZE], axis=1).tolist()
    boxes = []
    for row in good.tolist():
        time_us, where = times_us[row], f"{path} row {row}"
        if time_us not in vehicle:
            left_out["boxes"].append(f"{where}: there is no ego pose at {time_us} us")
            continue
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
    return build_tracks(boxes, left_out)


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
