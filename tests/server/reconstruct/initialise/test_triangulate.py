from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from real2sim_server.logs import DrivingLog, LidarSweep, ObjectTrack
from real2sim_server.reconstruct import InitialiseOptions, initialise_scene
from real2sim_server.reconstruct.initialise.triangulate import (
    RELATIVE_ERROR,
    TriangulatedPoints,
    triangulate,
)
from real2sim_server.scene import Camera, CameraRig, Trajectory
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

from ..conftest import FRAME_US, sweep_of

FRAMES, STEP = 6, 0.5
WALL_X, TEXEL = 14.0, 0.12
BOX_SIZE, BOX_X = (0.5, 3.0, 3.0), 9.0


@dataclass(frozen=True)
class TexturedSource:
    """A wall of random squares ahead of a vehicle, and a box that moves in front of it."""

    camera: Camera
    box: bool

    def image(self, camera: str, frame: int) -> np.ndarray:
        origin = self.camera.T_vehicle_camera[:3, 3] + [STEP * frame, 0, 0]
        rays = self._rays()
        image = self._texture(origin, rays, WALL_X, np.zeros(2), seed=1)
        if self.box:
            centre = box_centre(frame)
            near = self._texture(origin, rays, BOX_X, centre[1:], seed=2)
            at = origin + rays * ((BOX_X - origin[0]) / rays[..., :1])
            on_box = (np.abs(at[..., 1:] - centre[1:]) < np.array(BOX_SIZE[1:]) / 2).all(-1)
            image[on_box] = near[on_box]
        return image

    def _texture(self, origin, rays, x, offset, *, seed):
        at = origin + rays * ((x - origin[0]) / rays[..., :1])
        cells = np.floor((at[..., 1:] - offset) / TEXEL).astype(np.int64) % 256
        colours = np.random.default_rng(seed).integers(0, 255, (256, 256), dtype=np.uint8)
        return np.repeat(colours[cells[..., 0], cells[..., 1]][..., None], 3, axis=2)

    def lidar(self, frame: int) -> LidarSweep:
        return sweep_of(np.zeros((0, 3)))

    def _rays(self) -> np.ndarray:
        camera = self.camera
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
        return pixels @ np.linalg.inv(camera.K).T @ camera.T_vehicle_camera[:3, :3].T


def box_centre(frame: int) -> np.ndarray:
    return np.array([BOX_X + 0.25, 0.8 - 0.3 * frame, 1.6])


def textured_log(*, box: bool = False) -> DrivingLog:
    pose = T_VEHICLE_OPTICAL.copy()
    pose[:3, 3] = (0.0, 0.0, 1.6)
    camera = Camera("front", 240, 160, np.array([[220.0, 0, 120], [0, 220, 80], [0, 0, 1]]), pose)
    times = np.arange(FRAMES, dtype=np.int64) * FRAME_US
    ego = np.tile(np.eye(4), (FRAMES, 1, 1))
    ego[:, 0, 3] = STEP * np.arange(FRAMES)
    moving = np.tile(np.eye(4), (FRAMES, 1, 1))
    moving[:, :3, 3] = [box_centre(f) for f in range(FRAMES)]
    track = ObjectTrack("other_1", "other", BOX_SIZE, Trajectory.from_transforms(times, moving))
    return DrivingLog(
        name="textured",
        rig=CameraRig((camera,)),
        frame_times_us=times,
        ego=Trajectory.from_transforms(times, ego),
        tracks=(track,) if box else (),
        source=TexturedSource(camera, box),
    )


def points_of(log: DrivingLog, **options) -> TriangulatedPoints:
    return triangulate(log, **{"max_images": 60, "on_image": lambda done, total: None, **options})


@pytest.fixture(scope="module")
def wall() -> TriangulatedPoints:
    return points_of(textured_log())


def test_point_errors_match_their_stated_deviation(wall):
    error = np.abs(wall.points[:, 0] - WALL_X)
    assert len(wall) > 100
    assert np.median(error / wall.deviation) < 1
    assert np.percentile(error, 95) < RELATIVE_ERROR * WALL_X


def test_points_are_seen_in_at_least_three_images(wall):
    assert wall.sightings.min() >= 3
    assert wall.sightings.max() == FRAMES


def test_moving_boxes_give_no_points():
    found = points_of(textured_log(box=True)).points
    assert len(found) > 50
    assert found[:, 0].min() > BOX_X + 1


def test_triangulation_is_reproducible(wall):
    again = points_of(textured_log())
    assert np.array_equal(again.points, wall.points)


def test_a_stationary_vehicle_gives_no_points():
    log = textured_log()
    still = Trajectory.from_transforms(log.frame_times_us, np.tile(np.eye(4), (FRAMES, 1, 1)))
    assert len(points_of(replace(log, ego=still))) == 0


def test_no_images_give_no_points():
    assert len(points_of(textured_log(), max_images=0)) == 0


def test_progress_counts_images():
    seen = []
    points_of(textured_log(), max_images=4, on_image=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]


@pytest.mark.slow
def test_a_log_without_lidar_is_initialised_from_triangulated_points():
    log = textured_log(box=True)
    scene = initialise_scene(log, options=InitialiseOptions(ground_spacing=0.5))
    wall = scene.background.means[:, 0].numpy()
    assert (np.abs(wall - WALL_X) < 1.0).sum() > 50
    assert abs(float(scene.ground.height_at(np.array([[1.0, 0.0]]))[0])) < 0.02
    assert len(scene.object("other_1").cloud) > 100
