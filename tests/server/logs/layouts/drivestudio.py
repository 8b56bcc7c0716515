"""The preprocessed drivestudio folder of a Waymo segment."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from real2sim_server.logs import DrivingLog
from real2sim_server.logs.images import write_image
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

WORLD = np.array([-25211.0, 42391.0, -160.0])


def write(log: DrivingLog, folder: Path) -> None:
    for name in ("images", "ego_pose", "extrinsics", "intrinsics", "instances", "lidar"):
        (folder / name).mkdir(parents=True)
    for index, camera in enumerate(log.rig):
        k = camera.K
        numbers = (k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0, 0, 0, 0)
        np.savetxt(folder / f"intrinsics/{index}.txt", numbers)
        waymo_axes = camera.T_vehicle_camera @ np.linalg.inv(T_VEHICLE_OPTICAL)
        np.savetxt(folder / f"extrinsics/{index}.txt", waymo_axes)
    for frame, t_us in enumerate(log.frame_times_us.tolist()):
        np.savetxt(folder / f"ego_pose/{frame:03d}.txt", _shifted(log.ego.transform(t_us)))
        for index, name in enumerate(log.rig.names):
            write_image(folder / f"images/{frame:03d}_{index}.jpg", log.image(name, frame))
        sweep = log.lidar(frame)
        rows = np.zeros((len(sweep.points), 14), np.float32)
        rows[:, :3], rows[:, 3:6], rows[:, 11] = sweep.origin, sweep.points, sweep.intensity
        rows.tofile(folder / f"lidar/{frame:03d}.bin")
    instances = {}
    for number, track in enumerate(log.tracks):
        poses = [track.trajectory.transform(t) for t in log.frame_times_us.tolist()]
        instances[str(number)] = {
            "id": track.object_id,
            "class_name": "Vehicle",
            "frame_annotations": {
                "frame_idx": list(range(log.frame_count)),
                "obj_to_world": [_shifted(p).tolist() for p in poses],
                "box_size": [list(track.size)] * log.frame_count,
            },
        }
    (folder / "instances/instances_info.json").write_text(json.dumps(instances))


def _shifted(pose: np.ndarray) -> np.ndarray:
    moved = pose.copy()
    moved[:3, 3] += WORLD
    return moved
