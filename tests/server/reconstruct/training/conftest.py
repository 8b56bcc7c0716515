"""A small training problem, shared by the session."""

from __future__ import annotations

import math

import pytest

from real2sim_server.logs import DrivingLog
from real2sim_server.reconstruct import InitialiseOptions, initialise_scene
from real2sim_server.reconstruct.training import (
    DensifyOptions,
    LearningRates,
    TrainOptions,
    training_log,
)
from real2sim_server.reconstruct.training.schedule import DirectionOptions
from real2sim_server.scene import Scene
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log

TINY = TrainOptions(
    iterations=60,
    sh_every=0.3,
    sky_resolution=16,
    mirror=0.0,
    log_every=10,
    checkpoint_every=20,
    preview_every=0,
    # Complete vehicle bodies would dominate the rendering time.
    directions=DirectionOptions(close=False),
    initialise=InitialiseOptions(
        max_background=6_000,
        max_object=400,
        voxel=0.4,
        ground_spacing=0.5,
        object_voxel=0.2,
        sky_resolution=16,
    ),
    learning_rates=LearningRates(means=(5e-3, 5e-4), colour=0.03, scales=0.02, opacities=0.1),
    densify=DensifyOptions(every=10, start=0.1, stop=0.9, max_gaussians=40_000),
)


@pytest.fixture(scope="session")
def tiny_log() -> DrivingLog:
    config = SyntheticConfig(
        seed=3,
        frames=7,
        width=96,
        height=64,
        samples=1,
        cameras=(CameraSpec("front", fov=math.radians(70)),),
        lidar_beams=32,
        lidar_columns=360,
        parked_cars=3,
        moving_cars=2,
    )
    return generate_log(config)


@pytest.fixture(scope="session")
def tiny_scene(tiny_log: DrivingLog) -> Scene:
    return initialise_scene(training_log(tiny_log, 4), options=TINY.initialise)
