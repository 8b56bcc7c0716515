"""Small generated logs: a synthetic street, and a painted wall behind a painted box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from real2sim_server.logs import DrivingLog, LidarSweep, ObjectTrack
from real2sim_server.scene import Camera, CameraRig, Trajectory
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

WALL_X, WALL_COLOUR = 12.0, (40, 160, 60)
BOX_X, BOX_SIZE, BOX_COLOUR = 8.0, (1.0, 2.0, 1.6), (200, 40, 30)
ROAD_COLOUR, SKY_COLOUR = (110, 110, 115), (150, 190, 240)
FRAME_US = 100_000


@dataclass(frozen=True)
class PaintedSource:
    """Flat colours: a road, a wall across it, and a box that crosses in front of the wall."""

    camera: Camera
    boxes: bool
    lidar_points: bool

    def image(self, camera: str, frame: int) -> np.ndarray:
        direction, origin = self._rays(), self.camera.T_vehicle_camera[:3, 3]
        image = np.broadcast_to(np.array(SKY_COLOUR, np.uint8), (*direction.shape[:2], 3)).copy()
        nearest = np.full(direction.shape[:2], np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            road = np.where(direction[..., 2] < 0, -origin[2] / direction[..., 2], np.inf)
            wall = (WALL_X - origin[0]) / direction[..., 0]
        height = origin[2] + wall * direction[..., 2]
        wall = np.where((height < 4) & (height > 0), wall, np.inf)
        for distance, colour in ((road, ROAD_COLOUR), (wall, WALL_COLOUR)):
            image[distance < nearest] = colour
            nearest = np.minimum(nearest, distance)
        if self.boxes:
            distance = enter_box(direction, origin, box_centre(frame))
            image[distance < nearest] = BOX_COLOUR
        return image

    def lidar(self, frame: int) -> LidarSweep:
        if not self.lidar_points:
            return sweep_of(np.zeros((0, 3)))
        y, z = np.meshgrid(np.arange(-8, 8, 0.08), np.arange(0.05, 4, 0.08))
        wall = np.stack([np.full(y.size, WALL_X), y.ravel(), z.ravel()], axis=1)
        x, y = np.meshgrid(np.arange(1, WALL_X, 0.1), np.arange(-8, 8, 0.1))
        road = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        if not self.boxes:
            return sweep_of(np.concatenate([wall, road]))
        centre = box_centre(frame)
        y, z = np.meshgrid(np.arange(-0.98, 1, 0.06), np.arange(-0.78, 0.8, 0.06))
        front = centre + np.stack([np.full(y.size, -0.5), y.ravel(), z.ravel()], axis=1)
        seen = np.concatenate([wall, road])
        origin = np.array([0.0, 0, 1.7])
        hidden = enter_box(seen - origin, origin, centre) < 1
        return sweep_of(np.concatenate([seen[~hidden], front]))

    def _rays(self) -> np.ndarray:
        camera = self.camera
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        in_camera = np.stack(
            [
                (u - camera.K[0, 2]) / camera.K[0, 0],
                (v - camera.K[1, 2]) / camera.K[1, 1],
                np.ones_like(u),
            ],
            axis=-1,
        )
        return in_camera @ camera.T_vehicle_camera[:3, :3].T


def box_centre(frame: int) -> np.ndarray:
    return np.array([BOX_X, 2.4 - 0.6 * frame, BOX_SIZE[2] / 2])


def enter_box(direction: np.ndarray, origin: np.ndarray, centre: np.ndarray) -> np.ndarray:
    half = np.array(BOX_SIZE) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (centre - half - origin) / direction
        b = (centre + half - origin) / direction
    near, far = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    return np.where((near < far) & (far > 0), near, np.inf)


def sweep_of(points: np.ndarray) -> LidarSweep:
    n = len(points)
    return LidarSweep(
        points=points.astype(np.float32),
        intensity=np.full(n, 0.3, np.float32),
        offset_us=np.zeros(n, np.int32),
        origin=np.array([0, 0, 1.7], np.float32),
    )


def painted_log(*, boxes: bool = True, lidar: bool = True, frames: int = 9) -> DrivingLog:
    pose = T_VEHICLE_OPTICAL.copy()
    pose[:3, 3] = (0.0, 0.0, 1.6)
    k = np.array([[180.0, 0, 120], [0, 180.0, 70], [0, 0, 1]])
    camera = Camera("front", 240, 160, k, pose)
    times = np.arange(frames, dtype=np.int64) * FRAME_US
    still = np.broadcast_to(np.eye(4), (frames, 4, 4))
    moving = still.copy()
    moving[:, :3, 3] = [box_centre(f) for f in range(frames)]
    track = ObjectTrack("other_1", "other", BOX_SIZE, Trajectory.from_transforms(times, moving))
    return DrivingLog(
        name="painted",
        rig=CameraRig((camera,)),
        frame_times_us=times,
        ego=Trajectory.from_transforms(times, still),
        tracks=(track,) if boxes else (),
        source=PaintedSource(camera, boxes, lidar),
    )


@pytest.fixture(scope="session")
def synthetic_log() -> DrivingLog:
    from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log

    cameras = (CameraSpec("front"), CameraSpec("front_left", yaw=0.87, position=(1.6, 0.25, 1.6)))
    config = SyntheticConfig(
        seed=3, frames=6, width=160, height=120, cameras=cameras, samples=1, lidar_columns=720
    )
    return generate_log(config)
