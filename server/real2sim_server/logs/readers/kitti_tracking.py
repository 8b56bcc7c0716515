"""KITTI tracking layout, with poses from ``poses/`` (odometry format) or ``oxts/``.

World frame: the vehicle frame of frame 0 (x forward, y left, z up, rear axle on the ground).
Source: Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and the development
kit of the tracking benchmark.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...scene import Camera, CameraRig, Trajectory
from ..driving_log import DrivingLog, LidarSweep, LogError, ObjectTrack
from ..images import check_image_file, image_size, read_image
from .common import compensate_sweep, select_sequence
from .files import (
    check_frame_times,
    check_rigid,
    count_rows,
    parse_numbers,
    read_lines,
    read_number_table,
    read_rows,
)

# --- Text files ----------------------------------------------------------------------------------

# Calibration, poses, labels, time stamps.

VELODYNE_HEIGHT = 1.73
"""Height of the Velodyne above the road [m], from the KITTI sensor set-up drawing."""

FRAME_PERIOD_US = 100_000
EARTH_RADIUS = 6378137.0

_KEYS = {
    "rectification": ("R_rect", "R0_rect"),
    "velo_to_cam": ("Tr_velo_cam", "Tr_velo_to_cam"),
    "imu_to_velo": ("Tr_imu_velo", "Tr_imu_to_velo"),
}
_CATEGORIES = {"person": "pedestrian", "person_sitting": "pedestrian", "misc": "other"}


@dataclass(frozen=True, eq=False)
class KittiCalibration:
    """Calibration of one sequence.

    Attributes:
        projections: P0 to P3 [3, 4] by camera index: rectified cam0 coordinates to pixels.
        T_vehicle_velo, T_vehicle_imu: [4, 4] to the vehicle frame (rear axle on the ground).
        T_vehicle_cam0: [4, 4], rectified cam0 to vehicle.
    """

    projections: dict[int, Float]
    T_vehicle_velo: Float
    T_vehicle_imu: Float
    T_vehicle_cam0: Float


@dataclass(frozen=True)
class KittiLabel:
    """One box of one frame, in rectified cam0 coordinates.

    Attributes:
        frame, track_id: as in the file.
        category: the project's category, lower-case.
        size: (length, width, height) [m].
        T_cam0_object: [4, 4], origin at the box centre, x forward, z up.
    """

    frame: int
    track_id: int
    category: str
    size: tuple[float, float, float]
    T_cam0_object: Float


def read_calibration(path: Path) -> KittiCalibration:
    """Read ``calib/NNNN.txt`` in either spelling of its keys.

    The vehicle frame follows the published setup: the IMU is above the rear axle, the Velodyne on
    the centre line 1.73 m above the road. Its axes are those of the rectified cameras, which are
    levelled to the road more accurately than the Velodyne or the IMU.

    Raises:
        LogError: a matrix is missing, has a wrong number of values, or is not a rigid transform.
    """
    return calibration_from(read_entries(path), path)


def calibration_from(entries: Mapping[str, Float], path: Path) -> KittiCalibration:
    """A calibration from its matrices, named as in the tracking set; ``path`` is for errors."""
    rectification = _rigid(path, entries, _KEYS["rectification"])
    T_cam0_velo = rectification @ _rigid(path, entries, _KEYS["velo_to_cam"])
    T_velo_imu = _rigid(path, entries, _KEYS["imu_to_velo"])
    T_vehicle_velo = _place_velodyne(T_cam0_velo, T_velo_imu)
    projections = {
        i: entries[f"P{i}"].reshape(3, 4)
        for i in range(4)
        if f"P{i}" in entries and entries[f"P{i}"].size == 12
    }
    return KittiCalibration(
        projections=projections,
        T_vehicle_velo=T_vehicle_velo,
        T_vehicle_imu=T_vehicle_velo @ T_velo_imu,
        T_vehicle_cam0=T_vehicle_velo @ invert_transform(T_cam0_velo),
    )


def read_entries(path: Path, *, words: Sequence[str] = ()) -> dict[str, Float]:
    """Lines ``key: numbers`` of a calibration file; skips keys with text, given in ``words``.

    Raises:
        LogError: values that are not finite numbers; names the line.
    """
    entries = {}
    for number, line in enumerate(read_lines(path), start=1):
        key, _, values = line.replace(":", " ").strip().partition(" ")
        if key and key not in words:
            entries[key] = parse_numbers(values.split(), f"{path} line {number}")
    return entries


def _rigid(path: Path, entries: Mapping[str, Float], keys: tuple[str, ...]) -> Float:
    key = next((key for key in keys if key in entries), None)
    if key is None:
        raise LogError(f"{path}: has no line {' or '.join(f'{k}:' for k in keys)}")
    values = entries[key]
    if values.size not in (9, 12):
        raise LogError(f"{path}: {key} must hold 3x3 or 3x4 values, not {values.size}")
    matrix = np.eye(4)
    matrix[:3, : values.size // 3] = values.reshape(3, -1)
    return check_rigid(matrix, f"{path}: {key}")


def _place_velodyne(T_cam0_velo: Float, T_velo_imu: Float) -> Float:
    T_vehicle_velo = np.eye(4)
    T_vehicle_velo[:3, :3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ T_cam0_velo[:3, :3]
    T_vehicle_velo[0, 3] = -(T_vehicle_velo[:3, :3] @ T_velo_imu[:3, 3])[0]
    T_vehicle_velo[2, 3] = VELODYNE_HEIGHT
    return T_vehicle_velo


def read_poses(path: Path) -> Float:
    """``T_world_cam0`` [N, 4, 4] of a KITTI odometry pose file (12 numbers per line).

    Raises:
        LogError: with the line.
    """
    rows = read_number_table(path, columns=12, what="a 3x4 pose, row by row")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    for number, pose in enumerate(poses, start=1):
        check_rigid(pose, f"{path} line {number}")
    return poses


def read_oxts(path: Path) -> Float:
    """``T_world_imu`` [N, 4, 4] of an OXTS file (30 numbers per line), Mercator projection.

    As in the KITTI development kit, the projection is scaled by the cosine of the first latitude,
    and the rotation is Rz(yaw) Ry(pitch) Rx(roll).

    Raises:
        LogError: with the line.
    """
    return oxts_poses(read_number_table(path, columns=30, what="an OXTS record"))


def oxts_poses(rows: Float) -> Float:
    """``T_world_imu`` [N, 4, 4] of OXTS records [N, 30], see :func:`read_oxts`."""
    latitude, longitude, altitude, roll, pitch, yaw = rows[:, :6].T
    scale = np.cos(np.radians(latitude[0]))
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, 0, 3] = scale * EARTH_RADIUS * np.radians(longitude)
    poses[:, 1, 3] = scale * EARTH_RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    poses[:, 2, 3] = altitude
    poses[:, :3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    return poses


def _about(axis: int, angle: Float) -> Float:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.tile(np.eye(3), (len(angle), 1, 1))
    rotation[:, i, i] = rotation[:, j, j] = np.cos(angle)
    rotation[:, i, j], rotation[:, j, i] = -np.sin(angle), np.sin(angle)
    return rotation


def read_times(path: Path, frame_count: int) -> NDArray[np.int64]:
    """Frame times [F] [us], from ``path`` with one time per line [s], or at 10 Hz without the file.

    Raises:
        LogError: wrong count or order.
    """
    if not path.exists():
        return np.arange(frame_count, dtype=np.int64) * FRAME_PERIOD_US
    seconds = read_number_table(path, columns=1, what="seconds")[:, 0]
    if len(seconds) != frame_count:
        raise LogError(f"{path}: holds {len(seconds)} times, but there are {frame_count} frames")
    return check_frame_times(np.round(seconds * 1e6).astype(np.int64), str(path))


def read_labels(path: Path, frame_count: int) -> list[KittiLabel]:
    """All boxes of a tracking label file (17 columns), without ``DontCare`` regions.

    Raises:
        LogError: with the line, for wrong columns, frames outside the log, or sizes of zero.
    """
    labels = []
    for number, line in enumerate(read_lines(path), start=1):
        words = line.split()
        where = f"{path} line {number}"
        if len(words) != 17:
            raise LogError(
                f"{where}: expected 17 columns (frame id type truncated occluded alpha, 2D box, "
                f"h w l, x y z, ry), found {len(words)}"
            )
        if words[2] != "DontCare":
            labels.append(_parse_label(words, where, frame_count))
    return labels


def _parse_label(words: list[str], where: str, frame_count: int) -> KittiLabel:
    numbers = parse_numbers(words[:2] + words[10:], where)
    frame, track_id = int(numbers[0]), int(numbers[1])
    height, width, length, x, y, z, heading = numbers[2:]
    if not 0 <= frame < frame_count:
        raise LogError(f"{where}: frame {frame} is outside the log's 0 to {frame_count - 1}")
    if min(height, width, length) <= 0:
        raise LogError(f"{where}: box sizes must be positive, not {height} {width} {length}")
    kind = words[2].lower()
    cos, sin = np.cos(heading), np.sin(heading)
    pose = np.eye(4)
    # Columns: forward, left, up of the object in camera axes (x right, y down, z forward).
    pose[:3, :3] = np.array([[cos, sin, 0], [0, 0, -1], [-sin, cos, 0]])
    pose[:3, 3] = x, y - height / 2, z
    category = _CATEGORIES.get(kind, kind)
    return KittiLabel(frame, track_id, category, (length, width, height), pose)


SWEEP_US = 100_000
COLUMNS = 4
"""Columns of a scan's points: x, y, z, reflectance."""
MISSING_SCANS = {"0001": range(177, 181)}
"""Scans missing in the published data set, by sequence; these frames get an empty sweep."""

KITTI_EGO_SIZE = (4.77, 1.82, 1.50)
"""VW Passat B6 Variant, the recording car [m]."""


class KittiReader:
    """Reads the KITTI tracking layout."""

    name = "kitti"
    expects = (
        "[training/]image_02/<seq>/%06d.png (and image_00, 01, 03), velodyne/<seq>/%06d.bin, "
        "calib/<seq>.txt, label_02/<seq>.txt, poses/<seq>.txt or oxts/<seq>.txt"
    )

    def recognises(self, path: Path) -> bool:
        """Whether there are ``image_02`` and ``calib``, here or in ``training``."""
        root = _training_folder(path)
        return (root / "image_02").is_dir() and (root / "calib").is_dir()

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The drive ``sequence`` under the data set's root or its ``training`` folder.

        Cameras are named after their folders (``image_02``); the baselines in P0 to P3 are part of
        ``T_vehicle_camera``. Boxes come from ``boxes_surround`` (all vehicles in every frame) if it
        exists, else from ``label_02``. Sweeps are compensated to image time with the vehicle's own
        motion: the scanner turns clockwise and looks ahead when images are taken, so a point at
        azimuth a was measured ``-a / (2 pi) * 0.1 s`` later.

        Raises:
            LogError: see :class:`LogReader`.
        """
        root = _training_folder(path)
        sequence = _select_sequence(root, sequence)
        calibration = read_calibration(root / "calib" / f"{sequence}.txt")
        images = _image_files(root, sequence)
        frame_count = len(images["image_02"])
        rig = read_rig(root / "calib" / f"{sequence}.txt", calibration, images)
        scans = _scan_files(root / "velodyne" / sequence, sequence, frame_count)
        times_us = read_times(root / "times" / f"{sequence}.txt", frame_count)
        vehicle_poses, pose_source = _vehicle_poses(root, sequence, frame_count, calibration)
        labels, label_source = _labels(root, sequence, frame_count)
        return DrivingLog(
            name=f"kitti_{sequence}",
            rig=rig,
            frame_times_us=times_us,
            ego=Trajectory.from_transforms(times_us, vehicle_poses),
            tracks=_tracks(labels, vehicle_poses @ calibration.T_vehicle_cam0, times_us),
            source=KittiSource(rig, images, scans, calibration.T_vehicle_velo, vehicle_poses),
            ego_size=KITTI_EGO_SIZE,
            provenance={
                "dataset": "KITTI tracking layout",
                "sequence": sequence,
                "licence": "CC BY-NC-SA 3.0 (Geiger et al. 2013)",
                "reader": self.name,
                "poses": pose_source,
                "boxes": label_source,
            },
        )


def _training_folder(path: Path) -> Path:
    return path / "training" if (path / "training").is_dir() else path


def _select_sequence(root: Path, sequence: str | None) -> str:
    folder = root / "image_02"
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder; expected {KittiReader.expects}")
    known = sorted(p.name for p in folder.iterdir() if p.is_dir())
    return select_sequence(folder, known, sequence)


def _image_files(root: Path, sequence: str) -> dict[str, list[Path]]:
    """Files of every camera; all lists have the length of the longest."""
    folders, suffixes, frame_count = {}, {}, 0
    for folder in (root / f"image_{i:02d}" / sequence for i in range(4)):
        if folder.is_dir():
            name = folder.parent.name
            folders[name] = folder
            suffixes[name] = ".jpg" if (folder / "000000.jpg").exists() else ".png"
            count = sum(p.suffix == suffixes[name] for p in folder.iterdir())
            frame_count = max(frame_count, count)
    if frame_count == 0:
        raise LogError(f"{root / 'image_02' / sequence}: holds no images %06d.png")
    return {
        name: [folder / f"{f:06d}{suffixes[name]}" for f in range(frame_count)]
        for name, folder in folders.items()
    }


def read_rig(path: Path, calibration: KittiCalibration, images: dict[str, list[Path]]) -> CameraRig:
    """Cameras by name ``image_NN``; ``path`` is the calibration, for errors."""
    cameras = []
    for name, files in images.items():
        index = int(name[-2:])
        if index not in calibration.projections:
            raise LogError(f"{path}: has no line P{index}: with 12 values, needed for {name}")
        projection = calibration.projections[index]
        k = projection[:, :3].copy()
        if k[0, 0] <= 0 or k[1, 1] <= 0:
            raise LogError(f"{path}: P{index} needs positive focal lengths, not {projection}")
        T_camera_cam0 = np.eye(4)
        T_camera_cam0[:3, 3] = np.linalg.solve(k, projection[:, 3])
        # KITTI puts pixel centres at integers, a Camera at +0.5.
        k[:2, 2] += 0.5
        pose = calibration.T_vehicle_cam0 @ invert_transform(T_camera_cam0)
        width, height = image_size(files[0])
        cameras.append(Camera(name, width, height, k, pose))
    return CameraRig(tuple(cameras))


def _scan_files(folder: Path, sequence: str, frame_count: int) -> list[Path | None]:
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder; expected {frame_count} scans %06d.bin")
    scans: list[Path | None] = []
    for frame in range(frame_count):
        path = folder / f"{frame:06d}.bin"
        if not path.exists() and frame in MISSING_SCANS.get(sequence, ()):
            scans.append(None)
            continue
        scans.append(path)
    return scans


def _vehicle_poses(
    root: Path, sequence: str, frame_count: int, calibration: KittiCalibration
) -> tuple[Float, str]:
    poses_file, oxts_file = (root / folder / f"{sequence}.txt" for folder in ("poses", "oxts"))
    if poses_file.exists():
        path, poses, T_vehicle_sensor = (
            poses_file,
            read_poses(poses_file),
            calibration.T_vehicle_cam0,
        )
    elif oxts_file.exists():
        path, poses, T_vehicle_sensor = oxts_file, read_oxts(oxts_file), calibration.T_vehicle_imu
    else:
        raise LogError(f"no ego poses: neither {poses_file} nor {oxts_file} exists")
    if len(poses) != frame_count:
        raise LogError(f"{path}: holds {len(poses)} poses, but there are {frame_count} images")
    motion = invert_transform(poses[0]) @ poses
    return T_vehicle_sensor @ motion @ invert_transform(T_vehicle_sensor), path.parent.name


def _labels(root: Path, sequence: str, frame_count: int) -> tuple[list[KittiLabel], str | None]:
    for folder in ("boxes_surround", "label_02"):
        path = root / folder / f"{sequence}.txt"
        if path.exists():
            return read_labels(path, frame_count), folder
    if (root / "label_02").is_dir():
        raise LogError(f"{root / 'label_02' / sequence}.txt: no such file; it holds the boxes")
    return [], None


def _tracks(
    labels: list[KittiLabel], T_world_cam0: Float, times_us: NDArray[np.int64]
) -> tuple[ObjectTrack, ...]:
    by_object: dict[tuple[int, str], dict[int, KittiLabel]] = defaultdict(dict)
    for label in labels:
        by_object[label.track_id, label.category][label.frame] = label
    tracks = []
    for (track_id, category), boxes in sorted(by_object.items()):
        frames = sorted(boxes)
        transforms = [T_world_cam0[f] @ boxes[f].T_cam0_object for f in frames]
        length, width, height = np.median([boxes[f].size for f in frames], axis=0)
        tracks.append(
            ObjectTrack(
                object_id=f"{category}_{track_id}",
                category=category,
                size=(float(length), float(width), float(height)),
                trajectory=Trajectory.from_transforms(times_us[frames], np.array(transforms)),
            )
        )
    return tuple(tracks)


@dataclass(frozen=True, eq=False)
class KittiSource:
    """Files of a KITTI drive, and the data for motion compensation to image time."""

    rig: CameraRig
    images: dict[str, list[Path]]
    scans: list[Path | None]
    T_vehicle_velo: Float
    vehicle_poses: Float

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """RGB [H, W, 3]; see :class:`FrameSource`."""
        return read_image(self.images[camera][frame])

    def check_image(self, camera: str, frame: int) -> None:
        """See :class:`ChecksFiles`."""
        lens = self.rig[camera]
        check_image_file(self.images[camera][frame], (lens.width, lens.height))

    def check_sweep(self, frame: int) -> int:
        """See :class:`ChecksFiles`."""
        path = self.scans[frame]
        return 0 if path is None else count_rows(path, COLUMNS)

    def lidar(self, frame: int) -> LidarSweep:
        """The compensated scan; see :class:`FrameSource`."""
        scan = self._raw_scan(frame)
        points = scan[:, :3].astype(np.float64)
        offset = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
        in_vehicle = apply_transform(self.T_vehicle_velo, points)
        return LidarSweep(
            points=compensate_sweep(in_vehicle, offset, self.vehicle_poses, frame),
            intensity=np.clip(scan[:, 3], 0, 1),
            offset_us=np.round(offset * SWEEP_US).astype(np.int32),
            origin=self.T_vehicle_velo[:3, 3].astype(np.float32),
        )

    def _raw_scan(self, frame: int) -> NDArray[np.float32]:
        path = self.scans[frame]
        if path is None:
            return np.zeros((0, COLUMNS), dtype=np.float32)
        scan = read_rows(path, COLUMNS)
        return scan[np.isfinite(scan).all(axis=1)]
