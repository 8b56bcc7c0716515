"""Common parts of both editions of the Waymo Open Dataset, and the resulting log.

A frame's time stamp in the files is the start of a sweep of the TOP laser. Its pose, its boxes and
its points refer to the middle of the sweep, when the FRONT camera is triggered: the pose of the
frame is that of the FRONT image (github.com/waymo-research/waymo-open-dataset, issue 464). That is
the frame's time in the log. Pixel centres are at +0.5, as in a Camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...scene import Camera, CameraRig, Shutter, Trajectory
from ...scene.camera import DIRECTIONS, GLOBAL, MAX_READOUT_US, T_VEHICLE_OPTICAL
from ...scene.errors import LeftOut
from ..driving_log import DrivingLog, FrameSource, LidarSweep, LogError
from ..images import common_size
from .common import FrameBox, Lens, build_tracks, upright_pose
from .files import check_frame_times, check_rigid, read_numbers, read_rigid

# --- Range images --------------------------------------------------------------------------------

# Source: ``compute_range_image_polar`` and its neighbours in the data set's own
# ``range_image_utils``; the notes of ``dataset.proto``.

TOP = 1
"""Number of the only laser with a pose per pixel in its range images."""


@dataclass(frozen=True, eq=False)
class Laser:
    """Calibration of one laser.

    Attributes:
        number: 1 is TOP.
        inclinations: [N] float64 [rad], ascending; or None, then ``limits`` are divided evenly.
        limits: (lowest, highest) inclination [rad].
        T_vehicle_laser: [4, 4].

    Raises:
        LogError: a value is not finite, or the pose not rigid.
    """

    number: int
    inclinations: Float | None
    limits: tuple[float, float]
    T_vehicle_laser: Float

    def __post_init__(self) -> None:
        where = f"calibration of laser {self.number}"
        check_rigid(self.T_vehicle_laser, where)
        if not np.isfinite(
            [*self.limits, *(() if self.inclinations is None else self.inclinations)]
        ).all():
            raise LogError(f"{where}: holds an inclination that is not finite")

    def rows(self, height: int, where: str) -> Float:
        """Inclination [height] of each row of a range image; the first row is the highest.

        Raises:
            LogError: the number of rows differs from the number of the laser's beams.
        """
        if self.inclinations is None:
            low, high = self.limits
            return ((np.arange(height) + 0.5) / height * (high - low) + low)[::-1]
        if len(self.inclinations) != height:
            raise LogError(
                f"{where}: a range image of {height} rows, but laser {self.number} has "
                f"{len(self.inclinations)} beam inclinations"
            )
        return self.inclinations[::-1]

    def azimuths(self, width: int) -> Float:
        """Azimuth [width] [rad] of each column in the laser's own frame."""
        correction = np.arctan2(self.T_vehicle_laser[1, 0], self.T_vehicle_laser[0, 0])
        turn = (width - np.arange(width) - 0.5) / width * 2 - 1
        azimuths: Float = turn * np.pi - correction
        return azimuths


@dataclass(frozen=True, eq=False)
class RangeImage:
    """One return of one laser.

    Attributes:
        laser: its calibration.
        values: [H, W, C] float32: range [m] (0 or below: nothing), intensity, ...
        pixel_poses: [H, W, 6] float32 roll, pitch, yaw, x, y, z of ``T_world_vehicle`` at the time
            of each pixel; None: all points are already in the vehicle frame of the frame.
        where: file and place, for errors.
    """

    laser: Laser
    values: NDArray[np.float32]
    pixel_poses: NDArray[np.float32] | None
    where: str


@dataclass(frozen=True)
class SweepTiming:
    """Times of one sweep of the TOP laser, which rotates from the rear over the left to the front.

    Attributes:
        start_us: time of the first column relative to the frame's time stamp [us].
        duration_us: duration of the sweep [us].
    """

    start_us: float
    duration_us: float


def merge_range_images(
    images: Iterable[RangeImage], T_world_vehicle: Float, timing: SweepTiming
) -> LidarSweep:
    """All points of a frame in its vehicle frame.

    Points of the TOP laser are measured while it rotates; those of the other lasers have no times
    and get offset 0. Intensities are clipped to [0, 1].

    Args:
        images: all returns of all lasers.
        T_world_vehicle: pose of the frame [4, 4], in the world of the pixel poses.
        timing: times of the columns of the TOP laser.
    """
    points, intensities, offsets = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0)]
    origin = np.zeros(3)
    for image in images:
        row, column, found = pixel_points(image)
        if image.pixel_poses is not None:
            poses = image.pixel_poses[row, column].astype(np.float64)
            in_world = np.einsum("nij,nj->ni", rotations(poses[:, :3]), found) + poses[:, 3:]
            found = apply_transform(invert_transform(T_world_vehicle), in_world)
        points.append(found)
        intensities.append(np.clip(image.values[row, column, 1], 0, 1))
        width = image.values.shape[1]
        fraction = (column + 0.5) / width * timing.duration_us + timing.start_us
        offsets.append(fraction if image.laser.number == TOP else np.zeros(len(column)))
        if image.laser.number == TOP or not origin.any():
            origin = image.laser.T_vehicle_laser[:3, 3]
    return LidarSweep(
        points=np.concatenate(points).astype(np.float32),
        intensity=np.concatenate(intensities).astype(np.float32),
        offset_us=np.round(np.concatenate(offsets)).astype(np.int32),
        origin=origin.astype(np.float32),
    )


def pixel_points(image: RangeImage) -> tuple[NDArray[np.intp], NDArray[np.intp], Float]:
    """Pixels with a return, row by row.

    Rows [N], columns [N] and points [N, 3] float64, vehicle frame at the time of each pixel.
    """
    height, width = image.values.shape[:2]
    inclination = image.laser.rows(height, image.where)
    azimuth = image.laser.azimuths(width)
    ranges = image.values[..., 0].astype(np.float64)
    row, column = np.nonzero(np.isfinite(ranges) & (ranges > 0))
    distance, up, turned = ranges[row, column], inclination[row], azimuth[column]
    level = distance * np.cos(up)
    local = np.stack(
        [level * np.cos(turned), level * np.sin(turned), distance * np.sin(up)], axis=1
    )
    return row, column, apply_transform(image.laser.T_vehicle_laser, local)


def rotations(angles: Float) -> Float:
    """Matrices [N, 3, 3] of roll, pitch, yaw [N, 3] [rad]: Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angles(rotation: Float) -> Float:
    """Roll, pitch, yaw [..., 3] [rad] of rotations [..., 3, 3]; the inverse of rotations."""
    roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
    pitch = -np.arcsin(np.clip(rotation[..., 2, 0], -1, 1))
    yaw = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    return np.stack([roll, pitch, yaw], axis=-1)


CAMERA_NAMES = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
FRONT = 1
SHUTTERS = {
    1: "top_to_bottom",
    2: "left_to_right",
    3: "bottom_to_top",
    4: "right_to_left",
    5: "global",
}
CATEGORIES = {0: "other", 1: "car", 2: "pedestrian", 3: "sign", 4: "cyclist"}
TRUCK_LENGTH = 7.0
"""Minimum length of a truck [m]; Waymo has one type for all vehicles."""

EGO_SIZE = (5.18, 2.05, 1.78)
"""Chrysler Pacifica without its roof sensors [m]."""

SWEEP_US = 100_000
MAX_TIME_S = 1e12
MAX_DELAY_US = 1_000_000
"""Maximum time between the time stamp of a frame and its images [us]."""
LICENCE = "Waymo Open Dataset terms, non-commercial"


@dataclass(frozen=True, eq=False)
class WaymoCamera:
    """A camera: lens, pose on the vehicle in OpenCV's axes [4, 4], read-out direction."""

    number: int
    lens: Lens
    T_vehicle_camera: Float
    shutter: str

    @property
    def name(self) -> str:
        """The log's name of the camera."""
        return CAMERA_NAMES[self.number]


def waymo_camera(
    number: int,
    *,
    size: tuple[int, int],
    intrinsic: Sequence[float],
    extrinsic: Float,
    shutter: int,
    where: str,
) -> WaymoCamera:
    """A camera from its calibration: (width, height), [f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3].

    Raises:
        LogError: an unknown camera, or invalid values.
    """
    where = f"{where}: camera {number}"
    if number not in CAMERA_NAMES:
        raise LogError(f"{where} is unknown; known are {CAMERA_NAMES}")
    if len(intrinsic) != 9 or not np.isfinite(intrinsic).all() or min(intrinsic[:2]) <= 0:
        raise LogError(f"{where}: needs nine finite intrinsics, not {list(intrinsic)}")
    if min(size) < 1:
        raise LogError(f"{where}: size {size[0]}x{size[1]} is not positive")
    f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3 = (float(v) for v in intrinsic)
    k = np.array([[f_u, 0, c_u], [0, f_v, c_v], [0, 0, 1]])
    pose = check_rigid(extrinsic, f"{where}, extrinsic") @ T_VEHICLE_OPTICAL
    lens = Lens(size[0], size[1], k, (k1, k2, p1, p2, k3))
    return WaymoCamera(number, lens, pose, SHUTTERS.get(shutter, "unknown"))


def folder_cameras(path: Path, T_waymo_given: Float, left_out: LeftOut) -> list[WaymoCamera]:
    """Cameras of a folder with ``intrinsics/``, ``extrinsics/`` and ``images/*_<index>.*``.

    Args:
        path: the folder.
        T_waymo_given: [4, 4] from the axes of its extrinsics to those of Waymo's cameras, applied
            from the right.
        left_out: collects cameras without images or with a damaged calibration.
    """
    cameras = []
    for intrinsics in (path / "intrinsics").glob("*.txt"):
        with left_out.damaged("cameras"):
            if not intrinsics.stem.isdecimal():
                raise LogError(f"{intrinsics}: its name should be a camera's number")
            index = int(intrinsics.stem)
            images = sorted((path / "images").glob(f"*_{index}.*"))
            if not images:
                raise LogError(f"{path / 'images'}: camera {index} has no images")
            cameras.append(
                waymo_camera(
                    index + 1,
                    size=common_size(images),
                    intrinsic=read_numbers(intrinsics).tolist(),
                    extrinsic=read_rigid(path / "extrinsics" / intrinsics.name) @ T_waymo_given,
                    shutter=0,
                    where=str(intrinsics),
                )
            )
    return sorted(cameras, key=lambda camera: camera.number)


def folder_images(
    path: Path, camera: WaymoCamera, frames: Sequence[int], digits: int
) -> list[Path]:
    """The file of each frame in ``images/``; it need not exist."""
    index = camera.number - 1
    suffix = next((path / "images").glob(f"*_{index}.*")).suffix
    return [path / "images" / f"{frame:0{digits}d}_{index}{suffix}" for frame in frames]


@dataclass(frozen=True, eq=False)
class WaymoImage:
    """Time and vehicle pose of an image.

    Attributes:
        time_us: time of ``pose`` [us].
        pose: ``T_world_vehicle`` [4, 4].
        readout_us: time from the first to the last row or column [us].
    """

    time_us: int
    pose: Float
    readout_us: float


@dataclass(frozen=True)
class WaymoBox:
    """A box in the vehicle frame of its frame."""

    key: str
    type: int
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    heading: float
    where: str


@dataclass(frozen=True, eq=False)
class WaymoFrame:
    """One frame.

    Attributes:
        start_us: the frame's time stamp in the files [us].
        pose: ``T_world_vehicle`` [4, 4], in Waymo's world.
        images: images by camera number.
        boxes: LiDAR boxes.
        has_sweep: whether there is a range image of the TOP laser, which has most of the points.
    """

    start_us: int
    pose: Float
    images: Mapping[int, WaymoImage] = field(default_factory=dict)
    boxes: Sequence[WaymoBox] = ()
    has_sweep: bool = True

    @property
    def time_us(self) -> int:
        """Time of ``pose`` [us]."""
        front = self.images.get(FRONT)
        return front.time_us if front is not None else self.start_us + SWEEP_US // 2


def sweep_timings(frames: Sequence[WaymoFrame]) -> list[SweepTiming]:
    """Sweep times of the TOP laser, by frame."""
    starts = np.array([f.start_us for f in frames])
    duration = float(np.median(np.diff(starts))) if len(starts) > 1 else float(SWEEP_US)
    return [SweepTiming(f.start_us - f.time_us, duration) for f in frames]


def usable_frames(frames: Sequence[WaymoFrame], left_out: LeftOut, where: str) -> list[WaymoFrame]:
    """The frames in order of time, without those that have no rigid pose or no time of their own.

    Images that were not taken at the time of their frame are dropped.

    Raises:
        LogError: there is none.
    """
    by_time: dict[int, WaymoFrame] = {}
    for frame in frames:
        kept = len(by_time)
        with left_out.damaged("frames"):
            check_rigid(frame.pose, f"{where}: vehicle pose at {frame.start_us} us")
            if frame.start_us in by_time:
                raise LogError(f"{where}: there is a second frame at {frame.start_us} us")
            images = {
                number: image
                for number, image in frame.images.items()
                if abs(image.time_us - frame.start_us) <= MAX_DELAY_US
            }
            by_time[frame.start_us] = replace(frame, images=images)
        if len(by_time) == kept:
            for box in frame.boxes:
                left_out["boxes"].append(f"{box.where}: its frame is left out")
    if not by_time:
        raise LogError(f"{where}: has no frame with a pose")
    return [by_time[t] for t in sorted(by_time)]


def build_waymo_log(
    *,
    name: str,
    cameras: Sequence[WaymoCamera],
    frames: Sequence[WaymoFrame],
    source: FrameSource,
    where: str,
    provenance: Mapping[str, Any],
    left_out: LeftOut,
) -> DrivingLog:
    """The log; its world is the vehicle frame of the first frame.

    The ego's path passes through the poses of all frames and of all images. Cameras without any
    image are left out.

    Args:
        frames: of :func:`usable_frames`.
        left_out: collects the records that are not used.

    Raises:
        LogError: times out of order.
    """
    times_us = check_frame_times(np.array([f.time_us for f in frames], dtype=np.int64), where)
    to_first = invert_transform(frames[0].pose)
    used = []
    for camera in cameras:
        if any(camera.number in f.images for f in frames):
            with left_out.damaged("cameras"):
                _camera(camera, frames)
                used.append(camera)
        else:
            left_out["cameras"].append(f"{where}: camera {camera.name!r} has no images")
    absent = frozenset(
        (camera.name, i)
        for i, frame in enumerate(frames)
        for camera in used
        if camera.number not in frame.images
    )
    for i, frame in enumerate(frames):
        for camera in used:
            if (camera.name, i) in absent:
                told = f"{camera.name!r} has no usable image in the frame of {frame.start_us} us"
                left_out["images"].append(f"{where}: camera {told}")
    has_lidar = any(f.has_sweep for f in frames)
    no_sweep = frozenset(i for i, f in enumerate(frames) if has_lidar and not f.has_sweep)
    for i in sorted(no_sweep):
        told = f"the frame of {frames[i].start_us} us has no sweep of the TOP laser"
        left_out["sweeps"].append(f"{where}: {told}")
    tracks, keys = build_tracks(_boxes(frames, to_first, left_out), left_out)
    return DrivingLog(
        name=name,
        rig=CameraRig(tuple(_camera(c, frames) for c in used)),
        frame_times_us=times_us,
        ego=_ego(frames, to_first, left_out, where),
        tracks=tracks,
        source=source,
        ego_size=EGO_SIZE,
        provenance={
            **provenance,
            "licence": LICENCE,
            "track_ids": keys,
            "rolling_shutter": {c.name: _shutter(c, frames) for c in used},
        },
        image_times_us={
            c.name: np.array(
                [f.images[c.number].time_us if c.number in f.images else f.time_us for f in frames],
                dtype=np.int64,
            )
            for c in used
        },
        absent_images=absent,
        absent_sweeps=no_sweep,
        left_out=left_out.told(),
    )


def _camera(camera: WaymoCamera, frames: Sequence[WaymoFrame]) -> Camera:
    """The camera of the undistorted images, with its original optics. Raises SceneError."""
    said = _shutter(camera, frames)
    readout_us = round(said["readout_us"])
    rolls = said["direction"] in DIRECTIONS[1:] and 0 < readout_us <= MAX_READOUT_US
    shutter = Shutter(said["direction"], readout_us) if rolls else GLOBAL
    return camera.lens.camera(camera.name, camera.T_vehicle_camera, shutter)


def _boxes(frames: Sequence[WaymoFrame], to_first: Float, left_out: LeftOut) -> list[FrameBox]:
    boxes = []
    for frame in frames:
        to_world = to_first @ frame.pose
        for box in frame.boxes:
            with left_out.damaged("boxes"):
                boxes.append(
                    FrameBox(
                        key=box.key,
                        category=_category(box),
                        size=box.size,
                        time_us=frame.time_us,
                        T_world_object=to_world @ upright_pose(box.centre, box.heading),
                        where=box.where,
                    )
                )
    return boxes


def _category(box: WaymoBox) -> str:
    if box.type not in CATEGORIES:
        raise LogError(f"{box.where}: unknown type {box.type!r}; known are {CATEGORIES}")
    category = CATEGORIES[box.type]
    return "truck" if category == "car" and box.size[0] > TRUCK_LENGTH else category


def _ego(
    frames: Sequence[WaymoFrame], to_first: Float, left_out: LeftOut, where: str
) -> Trajectory:
    poses = {frame.time_us: frame.pose for frame in frames}
    for frame in frames:
        for number, image in sorted(frame.images.items()):
            with left_out.damaged("poses"):
                place = f"{where}: pose of image {number} at {frame.start_us} us"
                poses.setdefault(image.time_us, check_rigid(image.pose, place))
    times = sorted(poses)
    return Trajectory.from_transforms(times, to_first @ np.array([poses[t] for t in times]))


def _shutter(camera: WaymoCamera, frames: Sequence[WaymoFrame]) -> dict[str, Any]:
    images = [f.images[camera.number] for f in frames if camera.number in f.images]
    readout_us = float(np.median([image.readout_us for image in images]))
    return {"direction": camera.shutter, "readout_us": readout_us}
