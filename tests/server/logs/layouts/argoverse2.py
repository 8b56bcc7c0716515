"""Argoverse 2 sensor log: frames start with a LiDAR revolution, images are asynchronous."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import feather

from real2sim_server.geometry import invert_transform, matrix_to_quaternion
from real2sim_server.logs import DrivingLog
from real2sim_server.logs.images import write_image

AXLE = 0.33
FIRST_NS = 315966253660357000
CITY = np.array([5172.668, 2419.103, 66.93])
CLASSES = {"car": "REGULAR_VEHICLE", "truck": "LARGE_VEHICLE", "bus": "BUS"}
NAMES = {"front": "ring_front_center", "front_left": "ring_front_left"}


def write(log: DrivingLog, folder: Path) -> None:
    stamps = [FIRST_NS + int(t) * 1000 for t in log.frame_times_us]
    up, down = np.eye(4), np.eye(4)
    up[2, 3], down[2, 3] = AXLE, -AXLE
    poses = [log.ego.transform(int(t)) @ up for t in log.frame_times_us]
    in_city = [p.copy() for p in poses]
    for pose in in_city:
        pose[:3, 3] += CITY
    _feather(folder / "city_SE3_egovehicle.feather", {"timestamp_ns": stamps, **_poses(in_city)})
    _write_calibration(log, folder / "calibration", down)
    for name, camera in NAMES.items():
        for frame, ns in enumerate(stamps):
            # These images have the frame time; real ones deviate slightly.
            path = folder / "sensors/cameras" / camera / f"{ns}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, log.image(name, frame))
    for frame, ns in enumerate(stamps):
        sweep = log.lidar(frame)
        points = sweep.points - [0, 0, AXLE]
        columns = {n: points[:, i].astype(np.float16) for i, n in enumerate("xyz")}
        columns["intensity"] = np.round(sweep.intensity * 255).astype(np.uint8)
        columns["laser_number"] = np.zeros(len(points), np.uint8)
        columns["offset_ns"] = (sweep.offset_us.astype(np.int64) + 50_000) * 1000
        _feather(folder / f"sensors/lidar/{ns}.feather", columns)
    _write_annotations(log, folder / "annotations.feather", stamps, poses)


def _write_calibration(log: DrivingLog, folder: Path, down: np.ndarray) -> None:
    cameras = [log.rig[name] for name in NAMES]
    lidar = np.eye(4)
    lidar[:3, 3] = log.lidar(0).origin
    mounts = [down @ m for m in [*(c.T_vehicle_camera for c in cameras), lidar, lidar]]
    names = [*NAMES.values(), "up_lidar", "ring_rear_left"]
    _feather(folder / "egovehicle_SE3_sensor.feather", {"sensor_name": names, **_poses(mounts)})
    cameras.append(cameras[0])
    _feather(
        folder / "intrinsics.feather",
        {
            "sensor_name": [*NAMES.values(), "ring_rear_left"],
            "fx_px": [c.K[0, 0] for c in cameras],
            "fy_px": [c.K[1, 1] for c in cameras],
            "cx_px": [c.K[0, 2] - 0.5 for c in cameras],
            "cy_px": [c.K[1, 2] - 0.5 for c in cameras],
            "k1": [0.0] * 3,
            "k2": [0.0] * 3,
            "k3": [0.0] * 3,
            "height_px": np.array([c.height for c in cameras], np.uint16),
            "width_px": np.array([c.width for c in cameras], np.uint16),
        },
    )


def _write_annotations(log: DrivingLog, path: Path, stamps: list, poses: list) -> None:
    rows, boxes = [], []
    for frame, t_us in enumerate(log.frame_times_us):
        for track in log.tracks:
            boxes.append(invert_transform(poses[frame]) @ track.trajectory.transform(int(t_us)))
            rows.append((stamps[frame], track))
    columns = {
        "timestamp_ns": [ns for ns, _ in rows],
        "track_uuid": [t.object_id for _, t in rows],
        "category": [CLASSES.get(t.category, "BOLLARD") for _, t in rows],
        **{
            name: [t.size[i] for _, t in rows]
            for i, name in enumerate(("length_m", "width_m", "height_m"))
        },
    }
    _feather(path, {**columns, **_poses(boxes)})


def _poses(transforms: list) -> dict:
    matrices = np.array(transforms)
    quaternions = matrix_to_quaternion(matrices[:, :3, :3])
    names = {f"q{c}": quaternions[:, i] for i, c in enumerate("wxyz")}
    return names | {f"t{c}_m": matrices[:, i, 3] for i, c in enumerate("xyz")}


def _feather(path: Path, columns: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), str(path))
