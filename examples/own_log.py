"""Turn your own arrays into a log, check it, and reconstruct a scene from it.

Runs without a worker; needs ``pip install 'real2sim[server]'``. Replace ``record`` with your data.
``docs/log_format.md`` explains frames and times. Writes ``my_drive/`` and ``my_scene/``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from real2sim_server.geometry import (
    apply_transform,
    invert_transform,
    transform_from,
    yaw_quaternion,
)
from real2sim_server.logs import (
    DrivingLog,
    LidarSweep,
    ObjectTrack,
    inspect_log,
    open_log,
    write_native_log,
)
from real2sim_server.reconstruct import reconstruct
from real2sim_server.scene import Camera, CameraRig, Trajectory
from real2sim_server.scene.io import load_scene

T_VEHICLE_LIDAR = transform_from([1.2, 0.0, 1.8], yaw_quaternion(np.pi / 2))
T_VEHICLE_CAMERA = np.array([[0, 0, 1, 1.7], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1.0]])
K = np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])  # pixel centres at +0.5


@dataclass
class Recording:
    """A drive in memory; yours may read images and sweeps from files.

    Attributes:
        times_us: [F] times of the frames [us].
        T_world_vehicle: [F, 4, 4] poses of the rear axle's centre on the ground.
        T_world_car: [F, 4, 4] poses of the centre of the other car's box.
        images: [F, H, W, 3] uint8 RGB.
        points: for each frame [N, 3] in the LiDAR frame, motion-compensated [m].
    """

    times_us: NDArray[np.int64]
    T_world_vehicle: NDArray[np.float64]
    T_world_car: NDArray[np.float64]
    images: NDArray[np.uint8]
    points: list[NDArray[np.float64]]

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """The image of a camera in a frame."""
        return self.images[frame]

    def lidar(self, frame: int) -> LidarSweep:
        """The sweep of a frame, in the vehicle frame."""
        points = apply_transform(T_VEHICLE_LIDAR, self.points[frame])
        return LidarSweep(
            points=points.astype(np.float32),
            intensity=np.full(len(points), 0.3, np.float32),
            offset_us=np.zeros(len(points), np.int32),
            origin=T_VEHICLE_LIDAR[:3, 3].astype(np.float32),
        )


def record() -> Recording:
    """Five frames at 8 m/s past a wall, behind another car."""
    rng = np.random.default_rng(0)
    times_us = np.arange(5) * 100_000
    x = 8e-6 * times_us  # [m]
    straight = yaw_quaternion(np.zeros(5))
    T_world_vehicle = transform_from(np.stack([x, 0 * x, 0 * x], axis=1), straight)
    T_world_car = transform_from(np.stack([x + 12, 0 * x + 3, 0 * x + 0.75], axis=1), straight)
    points = []
    for offset, pose in zip(x, T_world_vehicle, strict=True):
        street = rng.uniform([-10, -8, 0], [40, 8, 0], (9000, 3))
        street[:3000, 1:] = rng.uniform([8, 0], [8, 4], (3000, 2))  # a wall on the left
        street[-600:] = rng.uniform([9.8, 2.1, 0.2], [9.9, 3.9, 1.4], (600, 3))  # the car's rear
        street[-600:, 0] += offset
        points.append(apply_transform(invert_transform(pose @ T_VEHICLE_LIDAR), street))
    images = rng.integers(0, 256, (5, 120, 160, 3), np.uint8)
    return Recording(times_us, T_world_vehicle, T_world_car, images, points)


def main() -> None:
    """Write the log, check it, and reconstruct it without training."""
    drive = record()
    path = Trajectory.from_transforms(drive.times_us, drive.T_world_car)
    log = DrivingLog(
        name="my_drive",
        rig=CameraRig((Camera("front", 160, 120, K, T_VEHICLE_CAMERA),)),
        frame_times_us=drive.times_us,
        ego=Trajectory.from_transforms(drive.times_us, drive.T_world_vehicle),
        tracks=(ObjectTrack("car_0", "car", (4.4, 1.8, 1.5), path),),
        source=drive,
    )
    write_native_log(log, "my_drive")
    log = open_log("my_drive")
    print("questions:", inspect_log(log).questions)
    reconstruct(log, "my_scene")
    scene = load_scene("my_scene")
    print(f"{len(scene.background):,} Gaussians, objects: {list(scene.objects)}")


if __name__ == "__main__":
    main()
