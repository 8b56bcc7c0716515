"""KITTI tracking layout, with poses from ``poses/`` (odometry format) or ``oxts/``.

World frame: the vehicle frame of frame 0 (x forward, y left, z up, rear axle on the ground).
Source: Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and the development
kit of the tracking benchmark.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, are_rigid, invert_transform
from ...scene import Camera, CameraRig, Trajectory
from ...scene.errors import LeftOut
from ..driving_log import NO_SWEEP, DrivingLog, LidarSweep, LogError, ObjectTrack
from ..images import IMAGE_SUFFIXES, check_image_file, common_size, read_image
from .common import FrameBox, build_tracks, compensate_sweep, select_sequence
from .files import (
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
MAX_FRAMES = 1_000_000
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
        frame, track_id, where: as in the file, and its line.
        category: the project's category, lower-case.
        size: (length, width, height) [m].
        T_cam0_object: [4, 4], origin at the box centre, x forward, z up.
    """

    frame: int
    track_id: int
    category: str
    size: tuple[float, float, float]
    T_cam0_object: Float
    where: str


def read_calibration(path: Path, left_out: LeftOut) -> KittiCalibration:
    """Read ``calib/NNNN.txt`` in either spelling of its keys.

    The vehicle frame follows the published setup: the IMU is above the rear axle, the Velodyne on
    the centre line 1.73 m above the road. Its axes are those of the rectified cameras, which are
    levelled to the road more accurately than the Velodyne or the IMU.

    Raises:
        LogError: a matrix is missing, has a wrong number of values, or is not a rigid transform.
    """
    return calibration_from(read_entries(path, left_out), path)


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


def read_entries(path: Path, left_out: LeftOut, *, words: Sequence[str] = ()) -> dict[str, Float]:
    """Lines ``key: numbers`` of a calibration file; skips keys with text, given in ``words``.

    The first of several lines with one key counts.
    """
    entries: dict[str, Float] = {}
    for number, line in enumerate(read_lines(path), start=1):
        key, _, values = line.replace(":", " ").strip().partition(" ")
        if not key or key in words:
            continue
        with left_out.damaged("lines"):
            where = f"{path} line {number}"
            if key in entries:
                raise LogError(f"{where}: has a second {key}")
            entries[key] = parse_numbers(values.split(), where)
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


def read_poses(path: Path, left_out: LeftOut) -> Float:
    """``T_world_cam0`` [N, 4, 4] of a KITTI odometry pose file (12 numbers per line).

    Damaged lines are matrices of NaN.
    """
    rows = read_number_table(path, columns=12, what="a 3x4 pose, row by row", left_out=left_out)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    for i in np.flatnonzero(~are_rigid(poses) & np.isfinite(rows).all(axis=1)):
        left_out["lines"].append(
            f"{path} line {i + 1}: its left 3x3 block is not a rotation matrix"
        )
        poses[i] = np.nan
    return poses


def read_oxts(path: Path, left_out: LeftOut) -> Float:
    """``T_world_imu`` [N, 4, 4] of an OXTS file (30 numbers per line), see :func:`oxts_poses`."""
    what = "an OXTS record"
    return oxts_poses(read_number_table(path, columns=30, what=what, left_out=left_out))


def oxts_poses(rows: Float) -> Float:
    """``T_world_imu`` [N, 4, 4] of OXTS records [N, 30], Mercator projection.

    As in the KITTI development kit, the projection is scaled by the cosine of the first latitude,
    and the rotation is Rz(yaw) Ry(pitch) Rx(roll). Records of NaN are matrices of NaN.
    """
    latitude, longitude, altitude, roll, pitch, yaw = rows[:, :6].T
    known = latitude[np.isfinite(latitude)]
    scale = np.cos(np.radians(known[0] if len(known) else 0.0))
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


def read_times(path: Path, frame_count: int, left_out: LeftOut) -> Float:
    """Frame times [F] [us], from ``path`` with one time per line [s], or at 10 Hz without the file.

    Damaged lines are NaN.

    Raises:
        LogError: the file has another number of lines.
    """
    if not path.exists():
        return np.arange(frame_count, dtype=np.float64) * FRAME_PERIOD_US
    seconds = read_number_table(path, columns=1, what="seconds", left_out=left_out)[:, 0]
    check_line_count(path, len(seconds), frame_count)
    times_us: Float = np.round(seconds * 1e6)
    return times_us


def check_line_count(path: Path, lines: int, frame_count: int) -> None:
    """Check that a file has a line for each frame, because its lines do not name their frames.

    Raises:
        LogError: otherwise.
    """
    if lines != frame_count:
        raise LogError(
            f"{path}: has {lines} lines, but the numbers of images and scans go to "
            f"{frame_count - 1}; its lines do not name their frames, so none can be missing"
        )


def usable_frames(
    times_us: NDArray[np.float64], poses: Float, left_out: LeftOut, where: Path
) -> NDArray[np.intp]:
    """Frames with a pose, and a time after that of the frame before; the others are left out.

    Raises:
        LogError: there is none.
    """
    kept: list[int] = []
    for frame, (t_us, pose) in enumerate(zip(times_us, poses, strict=True)):
        if not (np.isfinite(t_us) and np.isfinite(pose).all()):
            left_out["frames"].append(f"{where}: frame {frame} has no usable pose or time")
        elif kept and t_us <= times_us[kept[-1]]:
            told = f"frame {frame} is at {t_us:.0f} us, not after frame {kept[-1]}"
            left_out["frames"].append(f"{where}: {told}")
        else:
            kept.append(frame)
    if not kept:
        raise LogError(f"{where}: has no usable pose")
    return np.array(kept)


def read_labels(path: Path, frame_count: int, left_out: LeftOut) -> list[KittiLabel]:
    """All boxes of a tracking label file (17 columns), without ``DontCare`` regions.

    More columns, such as the score of a tracker, are ignored.
    """
    labels = []
    for number, line in enumerate(read_lines(path), start=1):
        words = line.replace(",", " ").split()
        if not words:
            continue
        with left_out.damaged("boxes"):
            where = f"{path} line {number}"
            if len(words) < 17:
                raise LogError(
                    f"{where}: expected 17 columns (frame id type truncated occluded alpha, 2D "
                    f"box, h w l, x y z, ry), found {len(words)}"
                )
            if words[2] != "DontCare":
                labels.append(_parse_label(words[:17], where, frame_count))
    return labels


def _parse_label(words: list[str], where: str, frame_count: int) -> KittiLabel:
    numbers = parse_numbers(words[:2] + words[10:], where)
    frame, track_id = int(numbers[0]), int(numbers[1])
    height, width, length, x, y, z, heading = numbers[2:]
    if not 0 <= frame < frame_count:
        raise LogError(f"{where}: frame {frame} is outside the log's 0 to {frame_count - 1}")
    kind = words[2].lower()
    cos, sin = np.cos(heading), np.sin(heading)
    pose = np.eye(4)
    # Columns: forward, left, up of the object in camera axes (x right, y down, z forward).
    pose[:3, :3] = np.array([[cos, sin, 0], [0, 0, -1], [-sin, cos, 0]])
    pose[:3, 3] = x, y - height / 2, z
    category = _CATEGORIES.get(kind, kind)
    return KittiLabel(frame, track_id, category, (length, width, height), pose, where)


SWEEP_US = 100_000
COLUMNS = 4
"""Columns of a scan's points: x, y, z, reflectance."""

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
        sequence, left_out = _select_sequence(root, sequence), LeftOut()
        calibration_file = root / "calib" / f"{sequence}.txt"
        calibration = read_calibration(calibration_file, left_out)
        folders = {f"image_{i:02d}": root / f"image_{i:02d}" / sequence for i in range(4)}
        scans = root / "velodyne" / sequence
        files = numbered_files(folders, scans, digits=6)
        rig = read_rig(calibration_file, calibration, files.images, left_out)
        times_us = read_times(root / "times" / f"{sequence}.txt", files.count, left_out)
        poses, T_vehicle_sensor, poses_file = _sensor_poses(
            root, sequence, files.count, calibration, left_out
        )
        frames = usable_frames(times_us, poses, left_out, poses_file)
        poses = vehicle_poses(poses, frames, T_vehicle_sensor)
        labels, label_source = _labels(root, sequence, files.count, left_out)
        tracks = _tracks(labels, poses @ calibration.T_vehicle_cam0, times_us, frames, left_out)
        chosen = times_us[frames].astype(np.int64)
        return DrivingLog(
            name=f"kitti_{sequence}",
            rig=rig,
            frame_times_us=chosen,
            ego=Trajectory.from_transforms(chosen, poses[frames]),
            tracks=tracks,
            source=KittiSource(rig, files, frames, calibration.T_vehicle_velo, poses),
            ego_size=KITTI_EGO_SIZE,
            provenance={
                "dataset": "KITTI tracking layout",
                "sequence": sequence,
                "licence": "CC BY-NC-SA 3.0 (Geiger et al. 2013)",
                "reader": self.name,
                "poses": poses_file.parent.name,
                "boxes": label_source,
            },
            left_out=left_out.told(),
        )


def _training_folder(path: Path) -> Path:
    return path / "training" if (path / "training").is_dir() else path


def _select_sequence(root: Path, sequence: str | None) -> str:
    folder = root / "image_02"
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder; expected {KittiReader.expects}")
    known = sorted(p.name for p in folder.iterdir() if p.is_dir())
    return select_sequence(folder, known, sequence)


@dataclass(frozen=True, eq=False)
class KittiFiles:
    """Files of the frames of a drive: images by camera, and scans (None without LiDAR)."""

    images: dict[str, list[Path]]
    scans: list[Path] | None

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(next(iter(self.images.values())))


def numbered_files(folders: Mapping[str, Path], scans: Path, *, digits: int) -> KittiFiles:
    """The files of all frames up to the highest number of an image or a scan.

    Args:
        folders: folders of images by camera; those that do not exist are skipped.
        scans: folder of scans ``.bin``.
        digits: digits of a number in file names.

    Raises:
        LogError: no image or scan is there.
    """
    suffixes, highest = {}, -1
    for name, folder in folders.items():
        images = [p for p in folder.glob("*") if p.suffix.lower() in IMAGE_SUFFIXES]
        numbered = [p for p in images if p.stem.isdecimal()]
        if numbered:
            suffixes[name] = Counter(p.suffix for p in numbered).most_common(1)[0][0]
            highest = max(highest, *(int(p.stem) for p in numbered))
    for path in scans.glob("*.bin"):
        if path.stem.isdecimal():
            highest = max(highest, int(path.stem))
    if not suffixes or not 0 <= highest < MAX_FRAMES:
        expected = ", ".join(str(folder / f"%0{digits}d.png") for folder in folders.values())
        raise LogError(f"there are no images; expected {expected}")
    names = [f"{frame:0{digits}d}" for frame in range(highest + 1)]
    return KittiFiles(
        {n: [folders[n] / f"{name}{suffix}" for name in names] for n, suffix in suffixes.items()},
        [scans / f"{name}.bin" for name in names] if scans.is_dir() else None,
    )


def read_rig(
    path: Path,
    calibration: KittiCalibration,
    images: Mapping[str, Sequence[Path]],
    left_out: LeftOut,
) -> CameraRig:
    """Cameras by name ``image_NN``; ``path`` is the calibration, for errors."""
    cameras = []
    for name, files in images.items():
        with left_out.damaged("cameras"):
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
            cameras.append(Camera(name, *common_size(files), k, pose))
    return CameraRig(tuple(cameras))


def _sensor_poses(
    root: Path, sequence: str, frame_count: int, calibration: KittiCalibration, left_out: LeftOut
) -> tuple[Float, Float, Path]:
    """Poses [F, 4, 4] of a sensor, NaN where a line is damaged; its ``T_vehicle_sensor``; file."""
    poses_file, oxts_file = (root / folder / f"{sequence}.txt" for folder in ("poses", "oxts"))
    if poses_file.exists():
        path, poses = poses_file, read_poses(poses_file, left_out)
        T_vehicle_sensor = calibration.T_vehicle_cam0
    elif oxts_file.exists():
        path, poses = oxts_file, read_oxts(oxts_file, left_out)
        T_vehicle_sensor = calibration.T_vehicle_imu
    else:
        raise LogError(f"no ego poses: neither {poses_file} nor {oxts_file} exists")
    check_line_count(path, len(poses), frame_count)
    return poses, T_vehicle_sensor, path


def vehicle_poses(sensor_poses: Float, frames: NDArray[np.intp], T_vehicle_sensor: Float) -> Float:
    """``T_world_vehicle`` [F, 4, 4] of all frames; the world is the first usable vehicle frame.

    Frames between usable ones get interpolated poses, which serve motion compensation.
    """
    motion = invert_transform(sensor_poses[frames[0]]) @ sensor_poses
    poses = T_vehicle_sensor @ motion @ invert_transform(T_vehicle_sensor)
    if len(frames) < len(poses):
        steps = Trajectory.from_transforms(frames, poses[frames])
        for frame in np.setdiff1d(np.arange(frames[0], frames[-1]), frames).tolist():
            poses[frame] = steps.transform(frame)
    return poses


def _labels(
    root: Path, sequence: str, frame_count: int, left_out: LeftOut
) -> tuple[list[KittiLabel], str | None]:
    for folder in ("boxes_surround", "label_02"):
        path = root / folder / f"{sequence}.txt"
        if path.exists():
            return read_labels(path, frame_count, left_out), folder
    if (root / "label_02").is_dir():
        missing = root / "label_02" / f"{sequence}.txt"
        left_out["files"].append(f"{missing}: no such file; it holds the boxes")
    return [], None


def _tracks(
    labels: list[KittiLabel],
    T_world_cam0: Float,
    times_us: NDArray[np.float64],
    frames: NDArray[np.intp],
    left_out: LeftOut,
) -> tuple[ObjectTrack, ...]:
    kept, boxes = set(frames.tolist()), []
    for label in labels:
        if label.frame not in kept:
            left_out["boxes"].append(f"{label.where}: its frame is left out")
            continue
        boxes.append(
            FrameBox(
                key=str(label.track_id),
                category=label.category,
                size=label.size,
                time_us=int(times_us[label.frame]),
                T_world_object=T_world_cam0[label.frame] @ label.T_cam0_object,
                where=label.where,
            )
        )
    return build_tracks(boxes, left_out, own_numbers=True)[0]


@dataclass(frozen=True, eq=False)
class KittiSource:
    """Files of a KITTI drive, and the data for motion compensation to image time.

    Attributes:
        rig: cameras.
        files: of all frames of the drive.
        frames: numbers of the log's frames.
        T_vehicle_velo: [4, 4].
        vehicle_poses: ``T_world_vehicle`` of all frames, see :func:`vehicle_poses`.
    """

    rig: CameraRig
    files: KittiFiles
    frames: NDArray[np.intp]
    T_vehicle_velo: Float
    vehicle_poses: Float

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """RGB [H, W, 3]; see :class:`FrameSource`."""
        return read_image(self._image_file(camera, frame))

    def check_image(self, camera: str, frame: int) -> None:
        """See :class:`ChecksFiles`."""
        lens = self.rig[camera]
        check_image_file(self._image_file(camera, frame), (lens.width, lens.height))

    def check_sweep(self, frame: int) -> int:
        """See :class:`ChecksFiles`."""
        scans = self.files.scans
        return 0 if scans is None else count_rows(scans[self.frames[frame]], COLUMNS)

    def lidar(self, frame: int) -> LidarSweep:
        """The compensated scan; see :class:`FrameSource`."""
        if self.files.scans is None:
            return NO_SWEEP
        number, first, last = self.frames[frame], self.frames[0], self.frames[-1]
        scan = read_rows(self.files.scans[number], COLUMNS)
        scan = scan[np.isfinite(scan).all(axis=1)]
        points = scan[:, :3].astype(np.float64)
        offset = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
        in_vehicle = apply_transform(self.T_vehicle_velo, points)
        poses = self.vehicle_poses[first : last + 1]
        return LidarSweep(
            points=compensate_sweep(in_vehicle, offset, poses, int(number - first)),
            intensity=np.clip(scan[:, 3], 0, 1),
            offset_us=np.round(offset * SWEEP_US).astype(np.int32),
            origin=self.T_vehicle_velo[:3, 3].astype(np.float32),
        )

    def _image_file(self, camera: str, frame: int) -> Path:
        return self.files.images[camera][int(self.frames[frame])]
