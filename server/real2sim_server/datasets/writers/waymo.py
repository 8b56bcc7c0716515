"""Waymo Open Dataset (perception), edition 2: one Parquet file per component and clip.

Source: the components of ``waymo_open_dataset.v2.perception`` and Sun et al., "Scalability in
Perception for Autonomous Driving: Waymo Open Dataset", CVPR 2020. A frame's time stamp is the start
of a sweep; pose, boxes, images and points refer to its middle. Boxes rotate about the vehicle's
vertical axis only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from real2sim_proto.conventions import SEMANTIC_CLASSES

from ...geometry import Float, apply_transform, matrix_to_quaternion, quaternion_yaw
from ...logs.readers.waymo_common import (
    CAMERA_NAMES,
    FRONT,
    TOP,
    Laser,
    RangeImage,
    angles,
    pixel_points,
)
from ...logs.readers.waymo_v2 import (
    BOX,
    CALIBRATION,
    CAMERA,
    IMAGE,
    INTRINSICS,
    LASER,
    LIDAR,
    LIDAR_CALIBRATION,
    LIDAR_POSE,
    OBJECT,
    POSE,
    TIME,
)
from ...render import encode_image
from ...scene import Camera
from ...scene.camera import T_VEHICLE_OPTICAL
from ..clips import Clip
from ..drive import DatasetError
from .categories import classes_of
from .nuscenes import FRONT as AHEAD
from .nuscenes import channels_of
from .writer import LabelledDrive, objects_of

SPLITS = {"train": "training", "val": "validation", "test": "testing"}
UNKNOWN = 0
SEGMENT, CAMERA_OBJECT = "key.segment_context_name", "key.camera_object_id"
CAMERA_BOX = "[CameraBoxComponent]"
PANOPTIC = "[CameraSegmentationLabelComponent]"
POINT_CLASS = "[LiDARSegmentationLabelComponent].range_image_return"
GLOBAL_SHUTTER = 5
COLUMNS = 4096
"""Columns of range images, finer than all LiDARs of the catalogue: one return per cell."""
LEVEL_1, LEVEL_2, FEW_POINTS = 1, 2, 5
"""Maximum number of points in a difficult box, as in the data set's evaluation."""
DIVISOR = 1000
QUALITY = 95
POINT_CLASSES = {"car": 1, "truck": 2, "bus": 3, "trailer": 4, "train": 4, "person": 7, "rider": 6}
POINT_CLASSES |= {"motorcycle": 13, "bicycle": 12, "traffic sign": 8, "traffic light": 9}
POINT_CLASSES |= {"pole": 10, "ground": 20}
"""Waymo's classes of points; all others are 0 (undefined)."""
PIXEL_CLASSES = {"car": 2, "truck": 3, "bus": 4, "trailer": 8, "train": 5, "person": 9, "rider": 10}
PIXEL_CLASSES |= {"motorcycle": 7, "bicycle": 6, "traffic sign": 17, "traffic light": 18}
PIXEL_CLASSES |= {"pole": 15, "sky": 25, "ground": 26, "dynamic": 27, "static": 28}
"""Waymo's classes of pixels; all others are 0 (undefined)."""


class WaymoWriter:
    """Writes ``<split>/<component>/<segment>.parquet``, one segment per clip."""

    name = "waymo"
    holds = "v2 components: poses, images, calibrations, LiDAR, 3D and 2D boxes, both segmentations"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError, and DatasetError for a sixth camera."""
        numbers = camera_numbers(drive.cameras)
        for clip in drive.clips:
            root = folder / SPLITS.get(clip.split, clip.split)
            segment = f"{drive.digest[:16]}_{clip.name}"
            with _Components(root, segment) as files:
                beams = _inclinations(drive, clip)
                _write_calibrations(files, drive, numbers, beams)
                covered = _cameras_covered(drive.cameras)
                for frame in clip.frames:
                    start_us = frame["t_us"] - drive.period_us // 2
                    _write_boxes(files, clip, frame, start_us)
                    _write_frame(
                        files, drive, clip, frame, start_us, numbers=numbers, covered=covered
                    )
                    _write_sweep(files, drive, clip, frame, start_us, beams=beams)


def camera_numbers(cameras: Sequence[Camera]) -> dict[str, int]:
    """Waymo's number of each camera: 1 for the most forward-looking one, others by Waymo's names if
    they match, otherwise free numbers.

    Raises:
        DatasetError: there are more than five cameras.
    """
    if len(cameras) > len(CAMERA_NAMES):
        raise DatasetError(f"format 'waymo' holds {len(CAMERA_NAMES)} cameras, not {len(cameras)}")
    ahead = next(name for name, channel in channels_of(cameras).items() if channel == AHEAD)
    numbers = {ahead: FRONT}
    known = {name: number for number, name in CAMERA_NAMES.items() if number != FRONT}
    numbers |= {c.name: known[c.name] for c in cameras if c.name in known and c.name != ahead}
    free = [number for number in CAMERA_NAMES if number not in numbers.values()]
    for camera in cameras:
        if camera.name not in numbers:
            numbers[camera.name] = free.pop(0)
    return numbers


class _Components:
    """One Parquet file per component of a segment; every call adds a row group."""

    def __init__(self, root: Path, segment: str) -> None:
        self._root, self._segment = root, segment
        self._open: dict[str, pq.ParquetWriter] = {}

    def __enter__(self) -> _Components:
        return self

    def __exit__(self, *_: object) -> None:
        for writer in self._open.values():
            writer.close()

    def add(self, component: str, columns: Mapping[str, Any]) -> None:
        rows = len(next(iter(columns.values())))
        table = pa.table({SEGMENT: pa.array([self._segment] * rows, pa.string()), **columns})
        if component not in self._open:
            path = self._root / component / f"{self._segment}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._open[component] = pq.ParquetWriter(path, table.schema, compression="zstd")
        self._open[component].write_table(table)


def _write_calibrations(
    files: _Components, drive: LabelledDrive, numbers: Mapping[str, int], beams: Float
) -> None:
    cameras = sorted(drive.cameras, key=lambda camera: numbers[camera.name])
    rows = [[c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2], 0, 0, 0, 0, 0] for c in cameras]
    mounts = np.array([c.T_vehicle_camera for c in cameras]) @ np.linalg.inv(T_VEHICLE_OPTICAL)
    shutters = [GLOBAL_SHUTTER] * len(cameras)
    files.add(
        "camera_calibration",
        {
            CAMERA: pa.array([numbers[c.name] for c in cameras], pa.int8()),
            **{
                f"{CALIBRATION}.intrinsic.{name}": pa.array([row[k] for row in rows], pa.float64())
                for k, name in enumerate(INTRINSICS)
            },
            f"{CALIBRATION}.extrinsic.transform": _matrices(mounts),
            f"{CALIBRATION}.width": pa.array([c.width for c in cameras], pa.int32()),
            f"{CALIBRATION}.height": pa.array([c.height for c in cameras], pa.int32()),
            f"{CALIBRATION}.rolling_shutter_direction": pa.array(shutters, pa.int8()),
        },
    )
    inclination = f"{LIDAR_CALIBRATION}.beam_inclination"
    files.add(
        "lidar_calibration",
        {
            LASER: pa.array([TOP], pa.int8()),
            f"{LIDAR_CALIBRATION}.extrinsic.transform": _matrices(_laser_pose(drive)[None]),
            f"{inclination}.min": pa.array([float(beams[0])], pa.float64()),
            f"{inclination}.max": pa.array([float(beams[-1])], pa.float64()),
            f"{inclination}.values": pa.array([beams], pa.list_(pa.float64())),
        },
    )


def _write_frame(
    files: _Components,
    drive: LabelledDrive,
    clip: Clip,
    frame: Mapping[str, Any],
    start_us: int,
    *,
    numbers: Mapping[str, int],
    covered: Mapping[str, bytes],
) -> None:
    velocity = _velocity(clip, frame)
    pose, seconds = _matrices(np.array(frame["T_world_ego"])[None]), [frame["t_us"] * 1e-6]
    files.add("vehicle_pose", {TIME: pa.array([start_us], pa.int64()), POSE: pose})
    shutter = f"{IMAGE}.rolling_shutter_params"
    for camera in sorted(drive.cameras, key=lambda camera: numbers[camera.name]):
        rgb = clip.pixels("rgb", camera.name, frame["index"])
        key = {
            TIME: pa.array([start_us], pa.int64()),
            CAMERA: pa.array([numbers[camera.name]], pa.int8()),
        }
        image = {
            f"{IMAGE}.image": [encode_image(rgb, "rgb", "jpeg", quality=QUALITY).data],
            f"{IMAGE}.pose.transform": pose,
            **velocity,
            f"{IMAGE}.pose_timestamp": seconds,
            f"{shutter}.shutter": [0.0],
            f"{shutter}.camera_trigger_time": seconds,
            f"{shutter}.camera_readout_done_time": seconds,
        }
        files.add("camera_image", {**key, **image})
        _write_camera_boxes(files, frame, camera.name, numbers[camera.name], start_us)
        covers = {f"{PANOPTIC}.num_cameras_covered": [covered[camera.name]]}
        files.add("camera_segmentation", {**key, **_panoptic(clip, camera.name, frame), **covers})


def _velocity(clip: Clip, frame: Mapping[str, Any]) -> dict[str, Any]:
    """Linear and angular velocity of the vehicle in the world, from the adjacent frames."""
    before, after, seconds = _around(clip, frame)
    poses = np.array([before["T_world_ego"], after["T_world_ego"]])
    moved = poses[1, :3, 3] - poses[0, :3, 3]
    turned = Rotation.from_matrix(poses[1, :3, :3] @ poses[0, :3, :3].T).as_rotvec()
    rows = (("linear", moved / seconds, pa.float32()), ("angular", turned / seconds, pa.float64()))
    return {
        f"{IMAGE}.velocity.{kind}_velocity.{axis}": pa.array([float(row[k])], type_)
        for kind, row, type_ in rows
        for k, axis in enumerate("xyz")
    }


def _around(clip: Clip, frame: Mapping[str, Any]) -> tuple[Any, Any, float]:
    """The frames before and after a frame, and the time between them [s].

    At the ends of a clip, the frame replaces the missing one. A clip of one frame has a time of 1.
    """
    place = next(k for k, other in enumerate(clip.frames) if other["index"] == frame["index"])
    before = clip.frames[max(place - 1, 0)]
    after = clip.frames[min(place + 1, len(clip.frames) - 1)]
    return before, after, (after["t_us"] - before["t_us"]) * 1e-6 or 1.0


def _cameras_covered(cameras: Sequence[Camera]) -> dict[str, bytes]:
    """One png per camera with the number of cameras that see each pixel's direction."""
    covered = {}
    for camera in cameras:
        directions = _directions(camera)
        count = np.zeros((camera.height, camera.width), np.uint8)
        for other in cameras:
            seen = directions @ other.T_vehicle_camera[:3, :3]
            x, y, w = np.moveaxis(seen @ other.K.T, -1, 0)
            ahead = seen[..., 2] > 0
            u, v = (np.divide(part, w, out=np.full_like(w, -1.0), where=ahead) for part in (x, y))
            count += (u >= 0) & (u < other.width) & (v >= 0) & (v < other.height) & ahead
        covered[camera.name] = bytes(cv2.imencode(".png", count)[1])
    return covered


def _directions(camera: Camera) -> Float:
    """[H, W, 3] of the rays through centres of pixels, frame of the vehicle."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    directions: Float = rays @ camera.T_vehicle_camera[:3, :3].T
    return directions


def _write_boxes(files: _Components, clip: Clip, frame: Mapping[str, Any], start_us: int) -> None:
    objects = frame["objects"]
    poses = np.array([subject["T_ego_object"] for subject in objects]).reshape(-1, 4, 4)
    vectors = {
        "box.center": poses[:, :3, 3],
        "box.size": np.array([subject["size"] for subject in objects]).reshape(-1, 3),
        # Along the axes of the world, as in Waymo.
        "speed": np.array([subject["velocity"] for subject in objects]).reshape(-1, 3),
        "acceleration": _accelerations(clip, frame),
    }
    headings = quaternion_yaw(matrix_to_quaternion(poses[:, :3, :3])) if len(poses) else np.zeros(0)
    counts = [subject["points"] for subject in objects]
    level = pa.array([LEVEL_2 if n <= FEW_POINTS else LEVEL_1 for n in counts], pa.int8())
    files.add(
        "lidar_box",
        {
            TIME: pa.array([start_us] * len(objects), pa.int64()),
            OBJECT: pa.array([subject["object_id"] for subject in objects], pa.string()),
            **{
                f"{BOX}.{part}.{axis}": pa.array(rows[:, k], pa.float64())
                for part, rows in vectors.items()
                for k, axis in enumerate("xyz")
            },
            f"{BOX}.box.heading": pa.array(headings, pa.float64()),
            f"{BOX}.type": pa.array([box_type(s["category"]) for s in objects], pa.int8()),
            f"{BOX}.num_lidar_points_in_box": pa.array(counts, pa.int64()),
            f"{BOX}.num_top_lidar_points_in_box": pa.array(counts, pa.int64()),
            f"{BOX}.difficulty_level.detection": level,
            f"{BOX}.difficulty_level.tracking": level,
        },
    )


def _accelerations(clip: Clip, frame: Mapping[str, Any]) -> Float:
    """Velocities [K, 3] of a frame's objects in the world, from the frames before and after."""
    before, after, seconds = _around(clip, frame)
    earlier, later = objects_of(before), objects_of(after)
    rows = np.zeros((len(frame["objects"]), 3))
    for k, subject in enumerate(frame["objects"]):
        own = subject["object_id"]
        # An object missing in one of the two frames uses the time between the other one and now.
        one, other = earlier.get(own, subject), later.get(own, subject)
        share = 1.0 if own in earlier and own in later else 0.5
        change = np.array(other["velocity"]) - np.array(one["velocity"])
        rows[k] = change / (seconds * share)
    return rows


def box_type(category: str) -> int:
    """Waymo's type of a box."""
    return classes_of(category).waymo or UNKNOWN


def _write_camera_boxes(
    files: _Components, frame: Mapping[str, Any], camera: str, number: int, start_us: int
) -> None:
    objects = objects_of(frame)
    seen = [view for view in frame["views"][camera] if view["box_2d_modal"] is not None]
    corners = np.array([view["box_2d_modal"] for view in seen], np.float64).reshape(-1, 2, 2)
    vectors = {"center": corners.mean(axis=1), "size": corners[:, 1] - corners[:, 0]}
    types = [box_type(objects[view["object_id"]]["category"]) for view in seen]
    files.add(
        "camera_box",
        {
            TIME: pa.array([start_us] * len(seen), pa.int64()),
            CAMERA: pa.array([number] * len(seen), pa.int8()),
            CAMERA_OBJECT: pa.array([view["object_id"] for view in seen], pa.string()),
            **{
                f"{CAMERA_BOX}.box.{part}.{axis}": pa.array(rows[:, k], pa.float64())
                for part, rows in vectors.items()
                for k, axis in enumerate("xy")
            },
            f"{CAMERA_BOX}.type": pa.array(types, pa.int8()),
            # Waymo's difficulty is a human annotation.
            f"{CAMERA_BOX}.difficulty_level.detection": pa.array([0] * len(seen), pa.int8()),
            f"{CAMERA_BOX}.difficulty_level.tracking": pa.array([0] * len(seen), pa.int8()),
        },
    )


def _panoptic(clip: Clip, camera: str, frame: Mapping[str, Any]) -> dict[str, Any]:
    """Class times DIVISOR plus the number of the object, as a 16-bit png."""
    semantic = clip.pixels("semantic", camera, frame["index"])
    instance = clip.pixels("instance", camera, frame["index"])
    label = _classes(PIXEL_CLASSES)[semantic] * DIVISOR + instance % DIVISOR
    done, data = cv2.imencode(".png", label.astype(np.uint16))
    assert done
    numbers = [number for number in np.unique(instance).tolist() if number]
    ids = pa.array([numbers], pa.list_(pa.int32()))
    mapping = f"{PANOPTIC}.instance_id_to_global_id_mapping"
    return {
        f"{PANOPTIC}.panoptic_label_divisor": pa.array([DIVISOR], pa.int32()),
        f"{PANOPTIC}.panoptic_label": [bytes(data)],
        f"{mapping}.local_instance_ids": ids,
        f"{mapping}.global_instance_ids": ids,
        f"{mapping}.is_tracked": pa.array([[True] * len(numbers)], pa.list_(pa.bool_())),
        f"{PANOPTIC}.sequence_id": [clip.name],
    }


def _write_sweep(
    files: _Components,
    drive: LabelledDrive,
    clip: Clip,
    frame: Mapping[str, Any],
    start_us: int,
    *,
    beams: Float,
) -> None:
    rows = clip.points(frame["index"])
    laser = Laser(TOP, beams, (float(beams[0]), float(beams[-1])), _laser_pose(drive))
    key = {TIME: pa.array([start_us], pa.int64()), LASER: pa.array([TOP], pa.int8())}
    returns = _returns(rows, laser)
    values: dict[str, Any] = {}
    classes: dict[str, Any] = {}
    for number, (place, own) in enumerate(returns, start=1):
        image = np.zeros((len(beams), COLUMNS, 4), np.float32)
        image[place[0], place[1], 0] = _ranges(own, laser)
        image[place[0], place[1], 1] = own["intensity"]
        values |= _cells(f"{LIDAR}.range_image_return{number}", image, pa.float32())
        label = np.zeros((len(beams), COLUMNS, 2), np.int32)
        label[place[0], place[1], 0] = own["instance"]
        label[place[0], place[1], 1] = _classes(POINT_CLASSES)[own["semantic"]]
        classes |= _cells(f"{POINT_CLASS}{number}", label, pa.int32())
    files.add("lidar", {**key, **values})
    files.add("lidar_segmentation", {**key, **classes})
    poses = _pixel_poses(returns, laser, np.array(frame["T_world_ego"]))
    files.add("lidar_pose", {**key, **_cells(LIDAR_POSE, poses, pa.float32())})


Place = tuple[NDArray[np.int64], NDArray[np.int64]]


def _returns(rows: NDArray[Any], laser: Laser) -> list[tuple[Place, NDArray[Any]]]:
    """Row and column of the points of both returns; a third in a cell is dropped."""
    x, y, _ = (rows["xyz"].astype(np.float64) - laser.T_vehicle_laser[:3, 3]).T
    assert laser.inclinations is not None
    row = len(laser.inclinations) - 1 - rows["beam"].astype(np.int64)
    turn = (np.pi - np.arctan2(y, x)) / (2 * np.pi)
    column = np.floor(turn * COLUMNS).astype(np.int64) % COLUMNS
    order = np.lexsort((rows["return_number"], row * COLUMNS + column))
    cell = (row * COLUMNS + column)[order]
    first = np.r_[True, cell[1:] != cell[:-1]][: len(cell)]
    second = ~first & np.r_[False, first[:-1]][: len(cell)]
    return [((row[order[k]], column[order[k]]), rows[order[k]]) for k in (first, second)]


def _ranges(rows: NDArray[Any], laser: Laser) -> Float:
    offsets: Float = rows["xyz"].astype(np.float64) - laser.T_vehicle_laser[:3, 3]
    return np.asarray(np.linalg.norm(offsets, axis=1))


def _pixel_poses(
    returns: Sequence[tuple[Place, NDArray[Any]]], laser: Laser, T_world_ego: Float
) -> NDArray[np.float32]:
    """[H, W, 6] poses that put each point at its measured position instead of the middle of its
    cell: the ego's rotation, and its position with the rounding error of the cell.
    """
    assert laser.inclinations is not None
    poses = np.zeros((len(laser.inclinations), COLUMNS, 6), np.float32)
    # The first return of a cell is written last, so its pose is exact.
    for place, rows in reversed(returns):
        values = np.zeros((len(laser.inclinations), COLUMNS, 2), np.float32)
        values[place[0], place[1], 0] = _ranges(rows, laser)
        row, column, middle = pixel_points(RangeImage(laser, values, None, "what is written"))
        order = np.argsort(place[0] * COLUMNS + place[1], kind="stable")
        measured = apply_transform(T_world_ego, rows["xyz"][order].astype(np.float64))
        poses[row, column, :3] = angles(T_world_ego[:3, :3])
        poses[row, column, 3:] = measured - middle @ T_world_ego[:3, :3].T
    return poses


def _inclinations(drive: LabelledDrive, clip: Clip) -> Float:
    """Elevation of each beam, ascending [rad]: medians in the clip's first frame with points."""
    for frame in clip.frames:
        rows = clip.points(frame["index"])
        if len(rows):
            x, y, z = (rows["xyz"].astype(np.float64) - drive.lidar_position).T
            up = np.arctan2(z, np.hypot(x, y))
            known = np.unique(rows["beam"])
            beams = np.array([np.median(up[rows["beam"] == beam]) for beam in known])
            every = np.arange(_beams(clip))
            found: Float = np.interp(every, known, np.maximum.accumulate(beams))
            return found + 1e-9 * every
    return np.zeros(1)


def _beams(clip: Clip) -> int:
    """Number of beams: one more than the highest beam of any frame."""
    rows = [clip.points(frame["index"])["beam"] for frame in clip.frames]
    return 1 + max((int(beams.max()) for beams in rows if len(beams)), default=0)


def _laser_pose(drive: LabelledDrive) -> Float:
    pose = np.eye(4)
    pose[:3, 3] = drive.lidar_position
    return pose


def _classes(known: Mapping[str, int]) -> NDArray[np.int32]:
    """Waymo class by class."""
    table = np.zeros(256, np.int32)
    for name, number in known.items():
        table[SEMANTIC_CLASSES[name]] = number
    return table


def _matrices(matrices: Float) -> Any:
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ravel(matrices)), 16)


def _cells(prefix: str, image: NDArray[Any], kind: pa.DataType) -> dict[str, Any]:
    return {
        f"{prefix}.values": pa.array([image.ravel()], pa.list_(kind)),
        f"{prefix}.shape": pa.array([list(image.shape)], pa.list_(pa.int32(), 3)),
    }
