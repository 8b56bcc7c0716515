"""Waymo Open Dataset (perception), edition 2: one Parquet file per component and segment.

Source: ``src/waymo_open_dataset/v2/perception`` of the data set's repository.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float
from ..driving_log import DrivingLog, LidarSweep, LogError
from ..images import check_encoded_image, decode_image
from .common import select_sequence
from .files import ParquetFile
from .waymo_common import (
    CAMERA_NAMES,
    TOP,
    Laser,
    RangeImage,
    SweepTiming,
    WaymoBox,
    WaymoCamera,
    WaymoFrame,
    WaymoImage,
    build_waymo_log,
    merge_range_images,
    sweep_timings,
    waymo_camera,
    with_sweeps,
)

TIME = "key.frame_timestamp_micros"
CAMERA = "key.camera_name"
LASER = "key.laser_name"
OBJECT = "key.laser_object_id"
POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
IMAGE = "[CameraImageComponent]"
CALIBRATION = "[CameraCalibrationComponent]"
LIDAR = "[LiDARComponent]"
LIDAR_CALIBRATION = "[LiDARCalibrationComponent]"
LIDAR_POSE = "[LiDARPoseComponent].range_image_return1"
BOX = "[LiDARBoxComponent]"
INTRINSICS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
SPLITS = ("training", "validation", "testing")


class WaymoV2Reader:
    """Reads ``<component>/<segment>.parquet``."""

    name = "waymo_v2"
    expects = (
        "vehicle_pose/<segment>.parquet and as many as there are of camera_image, "
        "camera_calibration, lidar, lidar_calibration, lidar_pose, lidar_box (here or in training/)"
    )

    def recognises(self, path: Path) -> bool:
        """Whether there is a folder ``vehicle_pose`` with Parquet files."""
        return any((_split(path) / "vehicle_pose").glob("*.parquet"))

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The segment ``sequence``; the only one by default.

        Images are undistorted when they are read, all lasers and both returns are merged, and the
        pixels of the TOP laser are moved by their own poses if ``lidar_pose`` exists. See
        :mod:`.waymo_common` for times.

        Raises:
            LogError: see :class:`LogReader`.
        """
        root = _split(path)
        known = sorted(p.stem for p in (root / "vehicle_pose").glob("*.parquet"))
        segment = select_sequence(root / "vehicle_pose", known, sequence)
        files = _SegmentFiles(root, segment)
        cameras = _read_cameras(files)
        images, lidar = _read_images(files), _open_lidar(files)
        read = _read_frames(files, images, _read_boxes(files), lidar)
        kept, left_out = with_sweeps(read)
        frames = [read[i] for i in kept]
        source = _WaymoV2Source(
            images=files.optional("camera_image"),
            rows={k: row for k, (row, _) in images.items()},
            cameras={c.name: c for c in cameras},
            lidar_files=lidar,
            frames=tuple(frames),
            timings=tuple(sweep_timings(frames)),
        )
        return build_waymo_log(
            name=f"waymo_{segment}",
            cameras=cameras,
            frames=frames,
            source=source,
            where=str(files.path("vehicle_pose")),
            provenance={
                "dataset": "Waymo Open Dataset v2",
                "sequence": segment,
                "reader": self.name,
            },
            left_out=left_out,
        )


def _split(path: Path) -> Path:
    folders = [path, *(path / name for name in SPLITS)]
    return next((f for f in folders if (f / "vehicle_pose").is_dir()), path)


@dataclass(frozen=True)
class _SegmentFiles:
    """The Parquet files of one segment."""

    root: Path
    segment: str

    def path(self, component: str) -> Path:
        return self.root / component / f"{self.segment}.parquet"

    def open(self, component: str) -> ParquetFile:
        return ParquetFile(self.path(component))

    def optional(self, component: str) -> ParquetFile | None:
        return self.open(component) if self.path(component).exists() else None


def _read_cameras(files: _SegmentFiles) -> list[WaymoCamera]:
    file = files.optional("camera_calibration")
    if file is None:
        if files.path("camera_image").exists():
            raise LogError(f"{files.path('camera_calibration')}: no such file; images need it")
        return []
    numbers = file.numbers(CAMERA)
    intrinsics = np.stack([file.numbers(f"{CALIBRATION}.intrinsic.{n}") for n in INTRINSICS], 1)
    extrinsics = _transforms(file, f"{CALIBRATION}.extrinsic.transform")
    sizes = np.stack([file.numbers(f"{CALIBRATION}.{n}") for n in ("width", "height")], 1)
    shutters = file.numbers(f"{CALIBRATION}.rolling_shutter_direction")
    return [
        waymo_camera(
            int(numbers[i]),
            size=(int(sizes[i, 0]), int(sizes[i, 1])),
            intrinsic=intrinsics[i].tolist(),
            extrinsic=extrinsics[i],
            shutter=int(shutters[i]),
            where=str(file.path),
        )
        for i in np.argsort(numbers, kind="stable")
    ]


def _transforms(file: ParquetFile, name: str) -> Float:
    values = file.numbers(name).astype(np.float64)
    if values.ndim != 2 or values.shape[1] != 16:
        raise LogError(f"{file.path}: {name!r} must hold 16 numbers each, not {values.shape[1:]}")
    return values.reshape(-1, 4, 4)


def _read_images(files: _SegmentFiles) -> dict[tuple[int, int], tuple[int, WaymoImage]]:
    """Row and pose of every image, by camera number and frame time stamp."""
    file = files.optional("camera_image")
    if file is None:
        return {}
    file.require([f"{IMAGE}.image"])
    numbers, times = file.numbers(CAMERA), file.numbers(TIME)
    poses = _transforms(file, f"{IMAGE}.pose.transform")
    seconds = file.numbers(f"{IMAGE}.pose_timestamp")
    readout = _readout_seconds(file)
    if not np.isfinite(seconds).all():
        raise LogError(f"{file.path}: '{IMAGE}.pose_timestamp' holds a value that is not finite")
    images = {}
    for row, (number, time) in enumerate(zip(numbers.tolist(), times.tolist(), strict=True)):
        if number not in CAMERA_NAMES or (number, time) in images:
            raise LogError(f"{file.path} row {row}: camera {number} is unknown or twice at {time}")
        image = WaymoImage(round(float(seconds[row]) * 1e6), poses[row], float(readout[row]) * 1e6)
        images[number, time] = row, image
    return images


def _readout_seconds(file: ParquetFile) -> Float:
    prefix = f"{IMAGE}.rolling_shutter_params"
    names = [
        f"{prefix}.{n}" for n in ("camera_readout_done_time", "camera_trigger_time", "shutter")
    ]
    if not set(names) <= file.names:
        return np.zeros(len(file))
    done, trigger, shutter = (file.numbers(n) for n in names)
    seconds: Float = done - trigger - shutter
    return seconds


def _read_boxes(files: _SegmentFiles) -> dict[int, list[WaymoBox]]:
    file = files.optional("lidar_box")
    boxes: dict[int, list[WaymoBox]] = defaultdict(list)
    if file is None:
        return boxes
    names = [f"{BOX}.box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"]
    numbers = np.stack([file.numbers(n) for n in (*names, f"{BOX}.box.heading")], 1)
    types, times = file.numbers(f"{BOX}.type"), file.numbers(TIME)
    for row, key in enumerate(file.texts(OBJECT)):
        x, y, z, length, width, height, heading = numbers[row].astype(np.float64).tolist()
        boxes[int(times[row])].append(
            WaymoBox(
                key=key,
                type=int(types[row]),
                centre=(x, y, z),
                size=(length, width, height),
                heading=heading,
                where=f"{file.path} row {row}",
            )
        )
    return boxes


def _read_frames(
    files: _SegmentFiles,
    images: Mapping[tuple[int, int], tuple[int, WaymoImage]],
    boxes: Mapping[int, list[WaymoBox]],
    lidar: _Lidar | None,
) -> list[WaymoFrame]:
    file = files.open("vehicle_pose")
    times, poses = file.numbers(TIME).tolist(), _transforms(file, POSE)
    if len(times) == 0:
        raise LogError(f"{file.path}: holds no poses")
    unmatched = ({t for _, t in images} | set(boxes)) - set(times)
    if unmatched:
        raise LogError(f"{file.path}: has no pose for the frame of {min(unmatched)} us")
    by_time: dict[int, dict[int, WaymoImage]] = defaultdict(dict)
    for (number, time), (_, image) in images.items():
        by_time[time][number] = image
    lasers: dict[int, set[int]] = defaultdict(set)
    for number, time in lidar.rows if lidar is not None else ():
        lasers[time].add(number)
    return [
        WaymoFrame(time, pose, by_time.get(time, {}), boxes.get(time, ()), frozenset(lasers[time]))
        for time, pose in zip(times, poses, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class _Lidar:
    """The files of range images, and the location of each frame in them."""

    ranges: ParquetFile
    poses: ParquetFile | None
    lasers: Mapping[int, Laser]
    rows: Mapping[tuple[int, int], int]
    pose_rows: Mapping[tuple[int, int], int]


def _open_lidar(files: _SegmentFiles) -> _Lidar | None:
    ranges = files.optional("lidar")
    if ranges is None:
        return None
    poses = files.optional("lidar_pose")
    for i in (1, 2):
        ranges.require([f"{LIDAR}.range_image_return{i}.{part}" for part in ("values", "shape")])
    if poses is not None:
        poses.require([f"{LIDAR_POSE}.values", f"{LIDAR_POSE}.shape"])
    shapes = [ranges.lists(f"{LIDAR}.range_image_return{i}.shape") for i in (1, 2)]
    seen = [any(s and 0 not in s for s in both) for both in zip(*shapes, strict=True)]
    rows = {key: row for key, row in _rows(ranges).items() if seen[row]}
    lasers = _read_lasers(files.open("lidar_calibration"))
    for number, _ in rows:
        if number not in lasers:
            raise LogError(f"{files.path('lidar_calibration')}: has no laser {number}")
    return _Lidar(ranges, poses, lasers, rows, _rows(poses) if poses is not None else {})


def _rows(file: ParquetFile) -> dict[tuple[int, int], int]:
    keys = zip(file.numbers(LASER).tolist(), file.numbers(TIME).tolist(), strict=True)
    return {key: row for row, key in enumerate(keys)}


def _read_lasers(file: ParquetFile) -> dict[int, Laser]:
    numbers = file.numbers(LASER)
    extrinsics = _transforms(file, f"{LIDAR_CALIBRATION}.extrinsic.transform")
    prefix = f"{LIDAR_CALIBRATION}.beam_inclination"
    low, high = file.numbers(f"{prefix}.min"), file.numbers(f"{prefix}.max")
    beams = file.lists(f"{prefix}.values")
    return {
        int(number): Laser(
            int(number),
            np.array(beams[i], dtype=np.float64) if beams[i] else None,
            (float(low[i]), float(high[i])),
            extrinsics[i],
        )
        for i, number in enumerate(numbers)
    }


@dataclass(frozen=True, eq=False)
class _WaymoV2Source:
    images: ParquetFile | None
    rows: Mapping[tuple[int, int], int]
    cameras: Mapping[str, WaymoCamera]
    lidar_files: _Lidar | None
    frames: tuple[WaymoFrame, ...]
    timings: tuple[SweepTiming, ...]

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        data, where = self._encoded(camera, frame)
        lens = self.cameras[camera].lens
        return lens.undistort(decode_image(data, where, (lens.width, lens.height)))

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError if the image is truncated or has a wrong size."""
        data, where = self._encoded(camera, frame)
        lens = self.cameras[camera].lens
        check_encoded_image(data, where, (lens.width, lens.height))

    def check_sweep(self, frame: int) -> int:
        """Read the sweep: sweeps have no separate header."""
        return len(self.lidar(frame).points)

    def lidar(self, frame: int) -> LidarSweep:
        files, here = self.lidar_files, self.frames[frame]
        images = [] if files is None else _range_images(files, here.start_us)
        return merge_range_images(images, here.pose, self.timings[frame])

    def _encoded(self, camera: str, frame: int) -> tuple[bytes, str]:
        number, start_us = self.cameras[camera].number, self.frames[frame].start_us
        if self.images is None or (number, start_us) not in self.rows:
            raise LogError(f"camera {camera!r} has no image in the frame of {start_us} us")
        row = self.rows[number, start_us]
        data = self.images.cell(f"{IMAGE}.image", row).as_py()
        return data or b"", f"{self.images.path} row {row} ({camera}, frame {frame})"


def _range_images(files: _Lidar, start_us: int) -> list[RangeImage]:
    images = []
    for number, laser in sorted(files.lasers.items()):
        row = files.rows.get((number, start_us))
        if row is None:
            continue
        poses = None
        pose_row = files.pose_rows.get((number, start_us))
        if number == TOP and files.poses is not None and pose_row is not None:
            poses = _array(files.poses, LIDAR_POSE, pose_row, channels=6)
        for i in (1, 2):
            values = _array(files.ranges, f"{LIDAR}.range_image_return{i}", row, channels=2)
            if values is not None:
                where = f"{files.ranges.path} row {row}, return {i}"
                _check_same_pixels(values, poses, where)
                images.append(RangeImage(laser, values, poses, where))
    return images


def _array(
    file: ParquetFile, prefix: str, row: int, *, channels: int
) -> NDArray[np.float32] | None:
    """[H, W, C] of a cell with C >= ``channels``; None if the cell is empty."""
    shape = file.cell(f"{prefix}.shape", row).as_py()
    cell = file.cell(f"{prefix}.values", row)
    if not shape or 0 in shape or not cell.is_valid:
        return None
    values = np.asarray(cell.values.to_numpy(zero_copy_only=False), dtype=np.float32)
    if len(shape) != 3 or shape[2] < channels or int(np.prod(shape)) != values.size:
        raise LogError(
            f"{file.path} row {row}: {prefix!r} has {values.size} values of shape {shape}; "
            f"expected height x width x at least {channels}"
        )
    return values.reshape(shape)


def _check_same_pixels(
    values: NDArray[np.float32], poses: NDArray[np.float32] | None, where: str
) -> None:
    if poses is not None and poses.shape[:2] != values.shape[:2]:
        raise LogError(f"{where}: {values.shape[:2]} pixels, but {poses.shape[:2]} poses")
