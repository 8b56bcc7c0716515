"""Fixtures: a straight street with cars, and worlds on it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from real2sim_proto.drive import ResetSpec
from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import yaw_quaternion
from real2sim_server.scene import Camera, CameraRig, GaussianCloud, Scene, SceneObject, Trajectory
from real2sim_server.world import World

STEP_US = 100_000
FRAMES = 121
START_US = 5_000_000
TIMES = START_US + np.arange(FRAMES) * STEP_US
IDENTITY = (1.0, 0.0, 0.0, 0.0)

MakeScene = Callable[..., Scene]
MakeWorld = Callable[..., World]


def straight(
    x: float = 0.0, y: float = 0.0, *, z: float = 0.0, speed: float = 0.0, yaw: float = 0.0
) -> Trajectory:
    way = (TIMES - START_US) * 1e-6 * speed
    heading = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    positions = np.array([x, y, z]) + way[:, None] * heading
    return Trajectory(TIMES, positions, np.tile(yaw_quaternion(yaw), (FRAMES, 1)))


def _point_cloud() -> GaussianCloud:
    return GaussianCloud(
        means=torch.zeros(1, 3),
        quats=torch.tensor([IDENTITY]),
        scales=torch.full((1, 3), 0.2),
        opacities=torch.full((1,), 0.9),
        sh=torch.zeros(1, 1, 3),
    )


@pytest.fixture(scope="session")
def make_scene() -> MakeScene:
    """A scene with an ego path and cars by id, each 4 x 2 x 1.6 m."""

    def make(ego: Trajectory | None = None, **cars: Trajectory) -> Scene:
        cloud = _point_cloud()
        K = np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]])
        cameras = tuple(Camera(name, 640, 360, K, np.eye(4)) for name in ("front", "left"))
        objects = {k: SceneObject(k, "car", (4.0, 2.0, 1.6), cloud, v) for k, v in cars.items()}
        path = ego if ego is not None else straight(speed=10.0)
        return Scene("street", cloud, objects, None, CameraRig(cameras), path, path.times_us)

    return make


@pytest.fixture(scope="session")
def make_world(make_scene: MakeScene) -> MakeWorld:
    """A world on ``make_scene(ego, **cars)``; keyword ``spec`` holds fields of its ResetSpec."""

    def make(ego: Trajectory | None = None, *, spec: dict | None = None, **cars: Trajectory):
        scene = make_scene(ego, **cars)
        return World(scene, ScenarioState.of(scene), ResetSpec(**(spec or {})))

    return make


@pytest.fixture(scope="session")
def moving() -> Callable[..., Trajectory]:
    """``moving(x, y, z=, speed=, yaw=)``: a straight trajectory over the length of the scene."""
    return straight
