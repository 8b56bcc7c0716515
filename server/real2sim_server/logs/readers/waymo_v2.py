"""Waymo Open Dataset (perception), edition 2: one Parquet file per component and segment.

Source: ``src/waymo_open_dataset/v2/perception`` of the data set's repository.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float
from ...scene.errors import LeftOut
from ..driving_log import DrivingLog, LidarSweep, LogError
from ..images import check_encoded_image, decode_image
from .common import select_sequence
from .files import ParquetFile
from .waymo_common import (
    MAX_TIME_S,
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
    usable_frames,
    waymo_camera,
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
        files, left_out = _SegmentFiles(root, segment), LeftOut()
        where = str(files.path("vehicle_pose"))
        cameras = _read_cameras(files, left_out)
        calibrated = {camera.number for camera in cameras}
        images, lidar = _read_images(files, calibrated, left_out), _open_lidar(files, left_out)
        frames = usable_frames(
            _read_frames(files, images, _read_boxes(files, left_out), lidar, left_out),
            left_out,
            where,
        )
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
            where=where,
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


def _read_cameras(files: _SegmentFiles, left_out: LeftOut) -> list[WaymoCamera]:
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
    cameras: dict[int, WaymoCamera] = {}
    for i in range(len(file)):
        with left_out.damaged("cameras"):
            number = int(numbers[i])
            if number in cameras:
                raise LogError(f"{file.path} row {i}: camera {number} is there twice")
            cameras[number] = waymo_camera(
                number,
                size=(int(sizes[i, 0]), int(sizes[i, 1])),
                intrinsic=intrinsics[i].tolist(),
                extrinsic=extrinsics[i],
                shutter=int(shutters[i]),
                where=str(file.path),
            )
    return [cameras[number] for number in sorted(cameras)]


def _transforms(file: ParquetFile, name: str) -> Float:
    """Matrices [N, 4, 4]; NaN where a cell does not hold 16 numbers."""
    values = file.numbers(name).astype(np.float64)
    if values.ndim != 2 or values.shape[1] != 16:
        raise LogError(f"{file.path}: {name!r} must hold 16 numbers each, not {values.shape[1:]}")
    return values.reshape(-1, 4, 4)


def _read_images(
    files: _SegmentFiles, cameras: Container[int], left_out: LeftOut
) -> dict[tuple[int, int], tuple[int, WaymoImage]]:
    """Row and pose of every image, by camera number and frame time stamp."""
    file = files.optional("camera_image")
    if file is None:
        return {}
    names = [f"{IMAGE}.image", f"{IMAGE}.pose.transform", f"{IMAGE}.pose_timestamp"]
    file.require(names)
    numbers, times = file.numbers(CAMERA), file.numbers(TIME)
    poses = _transforms(file, f"{IMAGE}.pose.transform")
    seconds = file.numbers(f"{IMAGE}.pose_timestamp")
    readout = _readout_seconds(file)
    images: dict[tuple[int, int], tuple[int, WaymoImage]] = {}
    for row in np.flatnonzero(file.complete([CAMERA, TIME], left_out)).tolist():
        number, time, where = int(numbers[row]), int(times[row]), f"{file.path} row {row}"
        with left_out.damaged("rows"):
            if number not in cameras or (number, time) in images:
                told = "has no calibration" if number not in cameras else f"is twice at {time} us"
                raise LogError(f"{where}: camera {number} {told}")
            if not abs(seconds[row]) < MAX_TIME_S:
                raise LogError(f"{where}: the image has no time")
            image = WaymoImage(
                round(float(seconds[row]) * 1e6), poses[row], float(readout[row]) * 1e6
            )
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


def _read_boxes(files: _SegmentFiles, left_out: LeftOut) -> dict[int, list[WaymoBox]]:
    file = files.optional("lidar_box")
    boxes: dict[int, list[WaymoBox]] = defaultdict(list)
    if file is None:
        return boxes
    names = [f"{BOX}.box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"]
    numbers = np.stack([file.numbers(n) for n in (*names, f"{BOX}.box.heading")], 1)
    types, times, keys = file.numbers(f"{BOX}.type"), file.numbers(TIME), file.texts(OBJECT)
    for row in np.flatnonzero(file.complete([TIME, OBJECT, f"{BOX}.type"], left_out)).tolist():
        x, y, z, length, width, height, heading = numbers[row].astype(np.float64).tolist()
        boxes[int(times[row])].append(
            WaymoBox(
                key=keys[row],
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
    left_out: LeftOut,
) -> list[WaymoFrame]:
    file = files.open("vehicle_pose")
    times, poses = file.numbers(TIME), _transforms(file, POSE)
    good = np.flatnonzero(file.complete([TIME], left_out)).tolist()
    posed = {int(times[row]) for row in good}
    for time in sorted({t for _, t in images} - posed):
        left_out["frames"].append(f"{file.path}: has no pose for the frame of {time} us")
    for time in sorted(set(boxes) - posed):
        for box in boxes[time]:
            left_out["boxes"].append(f"{box.where}: its frame of {time} us has no pose")
    by_time: dict[int, dict[int, WaymoImage]] = defaultdict(dict)
    for (number, time), (_, image) in images.items():
        by_time[time][number] = image
    tops = {time for number, time in lidar.rows if number == TOP} if lidar is not None else set()
    return [
        WaymoFrame(
            int(times[row]),
            poses[row],
            by_time.get(int(times[row]), {}),
            boxes.get(int(times[row]), ()),
            int(times[row]) in tops,
        )
        for row in good
    ]


@dataclass(frozen=True, eq=False)
class _Lidar:
    """The files of range images, and the location of each frame in them."""

    ranges: ParquetFile
    poses: ParquetFile | None
    lasers: Mapping[int, Laser]
    rows: Mapping[tuple[int, int], int]
    pose_rows: Mapping[tuple[int, int], int]


def _open_lidar(files: _SegmentFiles, left_out: LeftOut) -> _Lidar | None:
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
    rows = {key: row for key, row in _rows(ranges, left_out).items() if seen[row]}
    lasers = _read_lasers(files.open("lidar_calibration"), left_out)
    for number in sorted({number for number, _ in rows} - set(lasers)):
        told = f"has no usable laser {number}"
        left_out["LiDARs"].append(f"{files.path('lidar_calibration')}: {told}")
    rows = {key: row for key, row in rows.items() if key[0] in lasers}
    return _Lidar(ranges, poses, lasers, rows, _rows(poses, left_out) if poses is not None else {})


def _rows(file: ParquetFile, left_out: LeftOut) -> dict[tuple[int, int], int]:
    numbers, times = file.numbers(LASER), file.numbers(TIME)
    found: dict[tuple[int, int], int] = {}
    for row in np.flatnonzero(file.complete([LASER, TIME], left_out)).tolist():
        key = int(numbers[row]), int(times[row])
        if key in found:
            left_out["rows"].append(
                f"{file.path} row {row}: laser {key[0]} is twice at {key[1]} us"
            )
        else:
            found[key] = row
    return found


def _read_lasers(file: ParquetFile, left_out: LeftOut) -> dict[int, Laser]:
    numbers = file.numbers(LASER)
    extrinsics = _transforms(file, f"{LIDAR_CALIBRATION}.extrinsic.transform")
    prefix = f"{LIDAR_CALIBRATION}.beam_inclination"
    low, high = file.numbers(f"{prefix}.min"), file.numbers(f"{prefix}.max")
    beams = file.lists(f"{prefix}.values")
    lasers: dict[int, Laser] = {}
    for i in np.flatnonzero(file.complete([LASER], left_out)).tolist():
        number, where = int(numbers[i]), f"{file.path} row {i}"
        with left_out.damaged("rows"):
            if number in lasers:
                raise LogError(f"{where}: laser {number} is there twice")
            lasers[number] = Laser(
                number,
                np.array(beams[i], dtype=np.float64) if beams[i] else None,
                (float(low[i]), float(high[i])),
                extrinsics[i],
            )
    return lasers


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

    def check_sweep(self, frame: int) -> None:
        """Nothing to check: sweeps have no header of their own."""

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
