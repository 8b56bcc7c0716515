"""The preprocessed folder of Street Gaussians."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from real2sim_server.geometry import (
    invert_transform,
    matrix_to_quaternion,
    quaternion_yaw,
)
from real2sim_server.logs import DrivingLog
from real2sim_server.logs.images import write_image

WORLD = np.array([-25211.0, 42391.0, -160.0])
SENSORS = ("FRAME", "FRONT", "FRONT_LEFT", "FRONT_RIGHT")


def write(log: DrivingLog, folder: Path) -> None:
    for name in ("images", "ego_pose", "extrinsics", "intrinsics", "track"):
        (folder / name).mkdir(parents=True)
    for index, camera in enumerate(log.rig):
        k = camera.K
        numbers = (k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0, 0, 0, 0)
        np.savetxt(folder / f"intrinsics/{index}.txt", numbers)
        np.savetxt(folder / f"extrinsics/{index}.txt", camera.T_vehicle_camera)
    rows = ["frame_id track_id object_class alpha box_height box_width box_length x y z heading s"]
    for frame, t_us in enumerate(log.frame_times_us.tolist()):
        pose = log.ego.transform(t_us)
        shifted = pose.copy()
        shifted[:3, 3] += WORLD
        np.savetxt(folder / f"ego_pose/{frame:06d}.txt", shifted)
        for index, name in enumerate(log.rig.names):
            np.savetxt(folder / f"ego_pose/{frame:06d}_{index}.txt", shifted)
            write_image(folder / f"images/{frame:06d}_{index}.png", log.image(name, frame))
        for number, track in enumerate(log.tracks):
            box = invert_transform(pose) @ track.trajectory.transform(t_us)
            x, y, z = box[:3, 3]
            heading = float(quaternion_yaw(matrix_to_quaternion(box[:3, :3])))
            length, width, height = track.size
            rows.append(
                f"{frame} {number} vehicle 0 {height} {width} {length} "
                f"{x:.9f} {y:.9f} {z:.9f} {heading:.9f} 0"
            )
    (folder / "track/track_info.txt").write_text("\n".join(rows) + "\n")
    seconds = {f"{f:06d}": int(t) * 1e-6 for f, t in enumerate(log.frame_times_us)}
    (folder / "timestamps.json").write_text(json.dumps(dict.fromkeys(SENSORS, seconds)))
    clouds = {f: log.lidar(f).points for f in range(log.frame_count)}
    views = {f: np.zeros((len(p), 6), np.int16) for f, p in clouds.items()}
    np.savez(folder / "pointcloud.npz", pointcloud=clouds, camera_projection=views)
