"""nuScenes: token tables, far from the map origin, with boxes in every frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from real2sim_server.geometry import (
    apply_transform,
    invert_transform,
    matrix_to_quaternion,
)
from real2sim_server.logs import DrivingLog
from real2sim_server.logs.images import write_image

MAP = np.array([411.3, 1180.9, 0.0])
FIRST_US = 1532402927647951
CHANNELS = {"front": "CAM_FRONT", "front_left": "CAM_FRONT_LEFT"}
SWEEP_LATE_US = 12_000
CLASSES = {"car": "vehicle.car", "truck": "vehicle.truck", "bus": "vehicle.bus.rigid"}


def write(log: DrivingLog, root: Path) -> None:
    mount = np.eye(4)
    mount[:3, 3] = log.lidar(0).origin
    mounts = {CHANNELS[n]: log.rig[n].T_vehicle_camera for n in CHANNELS} | {"LIDAR_TOP": mount}
    tables: dict[str, list[dict]] = {
        "scene": [{"token": "sc", "name": "scene-0061"}],
        "sample": [
            {"token": f"s{f}", "scene_token": "sc", "timestamp": FIRST_US + int(t)}
            for f, t in enumerate(log.frame_times_us)
        ],
        "category": [{"token": f"c_{k}", "name": v} for k, v in CLASSES.items()],
        "instance": [
            {"token": t.object_id, "category_token": f"c_{_kind(t.category)}"} for t in log.tracks
        ],
        "sensor": [{"token": f"n_{c}", "channel": c} for c in mounts],
        "calibrated_sensor": [
            {
                "token": f"cs_{channel}",
                "sensor_token": f"n_{channel}",
                "camera_intrinsic": _intrinsic(log, channel),
                **_pose(pose),
            }
            for channel, pose in mounts.items()
        ],
        "sample_data": [],
        "ego_pose": [],
        "sample_annotation": [],
    }
    for frame in range(log.frame_count):
        _add_frame(tables, log, frame, root, mount)
    # The last sweep is late, so the poses must extend beyond it.
    _add_pose(tables, log, "end", int(log.frame_times_us[-1]) + 200_000)
    row = dict(tables["sample_data"][-1])
    tables["sample_data"].append(
        row | {"token": "d_end", "timestamp": FIRST_US + int(log.frame_times_us[-1]) + 200_000,
               "ego_pose_token": "e_end"}
    )  # fmt: skip
    (root / "v1.0-mini").mkdir(parents=True)
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))


def _kind(category: str) -> str:
    return category if category in CLASSES else "car"


def _intrinsic(log: DrivingLog, channel: str) -> list:
    for name, known in CHANNELS.items():
        if known == channel:
            k = log.rig[name].K.copy()
            k[:2, 2] -= 0.5
            return k.tolist()
    return []


def _pose(pose: np.ndarray) -> dict:
    quaternion = matrix_to_quaternion(pose[:3, :3])
    return {"translation": pose[:3, 3].tolist(), "rotation": quaternion.tolist()}


def _ego(log: DrivingLog, t_us: int) -> np.ndarray:
    """Ego pose, extrapolated at constant velocity outside the log."""
    edge = min(max(t_us, log.ego.start_us), log.ego.end_us)
    pose = log.ego.transform(edge)
    pose[:3, 3] += log.ego.velocity(edge) * (t_us - edge) * 1e-6
    return pose


def _add_pose(tables: dict, log: DrivingLog, name: str, t_us: int) -> None:
    pose = _ego(log, t_us)
    pose[:3, 3] += MAP
    tables["ego_pose"].append({"token": f"e_{name}", "timestamp": FIRST_US + t_us, **_pose(pose)})


def _add_frame(tables: dict, log: DrivingLog, frame: int, root: Path, mount: np.ndarray) -> None:
    t_us = int(log.frame_times_us[frame])
    for name, channel in CHANNELS.items():
        file = f"samples/{channel}/n008__{channel}__{frame}.jpg"
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        write_image(root / file, log.image(name, frame))
        _add_data(tables, log, frame, channel, t_us, file, log.rig[name])
    file = f"sweeps/LIDAR_TOP/n008__LIDAR_TOP__{frame}.pcd.bin"
    (root / file).parent.mkdir(parents=True, exist_ok=True)
    late = invert_transform(_ego(log, t_us + SWEEP_LATE_US) @ mount) @ log.ego.transform(t_us)
    sweep = log.lidar(frame)
    rows = np.zeros((len(sweep.points), 5), np.float32)
    rows[:, :3] = apply_transform(late, sweep.points)
    rows[:, 3] = np.round(sweep.intensity * 255)
    rows.tofile(root / file)
    _add_data(tables, log, frame, "LIDAR_TOP", t_us + SWEEP_LATE_US, file, None)
    for track in log.tracks:
        pose = track.trajectory.transform(t_us)
        pose[:3, 3] += MAP
        length, width, height = track.size
        tables["sample_annotation"].append(
            {
                "token": f"a{frame}_{track.object_id}",
                "sample_token": f"s{frame}",
                "instance_token": track.object_id,
                "size": [width, length, height],
                **_pose(pose),
            }
        )


def _add_data(
    tables: dict, log: DrivingLog, frame: int, channel: str, t_us: int, file: str, lens: object
) -> None:
    _add_pose(tables, log, f"{frame}_{channel}", t_us)
    tables["sample_data"].append(
        {
            "token": f"d{frame}_{channel}",
            "sample_token": f"s{frame}",
            "ego_pose_token": f"e_{frame}_{channel}",
            "calibrated_sensor_token": f"cs_{channel}",
            "timestamp": FIRST_US + t_us,
            "filename": file,
            "width": getattr(lens, "width", 0),
            "height": getattr(lens, "height", 0),
        }
    )
