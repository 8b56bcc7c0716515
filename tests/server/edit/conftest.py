"""A small street without Gaussians, on which scenarios are edited."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from real2sim_server.edit import ScenarioState
from real2sim_server.geometry import yaw_quaternion
from real2sim_server.scene import GaussianCloud, Trajectory
from real2sim_server.scene.ground_fit import fit_scene_ground

STEP_US = 100_000
FRAMES = 50


def drive(
    x: float, y: float, *, speed: float = 0.0, yaw: float = 0.0, first: int = 0, last: int = FRAMES
) -> Trajectory:
    """A box centre 0.8 m above the ground, straight on from (x, y) between two frames."""
    times = np.arange(first, last) * STEP_US
    way = times * 1e-6 * speed
    positions = np.stack(
        [x + way * np.cos(yaw), y + way * np.sin(yaw), np.full(len(times), 0.8)], axis=1
    )
    return Trajectory(times, positions, np.tile(yaw_quaternion(yaw), (len(times), 1)))


def turning(x: float, y: float, *, radius: float, speed: float) -> Trajectory:
    """The same on a circle to the left."""
    times = np.arange(FRAMES) * STEP_US
    yaw = times * 1e-6 * speed / radius
    positions = np.stack(
        [x + radius * np.sin(yaw), y + radius * (1 - np.cos(yaw)), np.full(FRAMES, 0.8)], axis=1
    )
    return Trajectory(times, positions, yaw_quaternion(yaw))


def on_the_ground(trajectory: Trajectory) -> Trajectory:
    """The same for a vehicle, whose origin is on the ground."""
    flat = trajectory.positions * [1.0, 1.0, 0.0]
    return Trajectory(trajectory.times_us, flat, trajectory.quaternions)


def thing(object_id: str, trajectory: Trajectory, *, category: str = "car") -> SimpleNamespace:
    return SimpleNamespace(
        object_id=object_id, category=category, size=(4.0, 2.0, 1.6), trajectory=trajectory
    )


@pytest.fixture(scope="session")
def summary() -> SimpleNamespace:
    """A parked, a crossing, a turning and a late car, and the ego's path."""
    objects = [
        thing("parked", drive(20.0, 5.0)),
        thing("crossing", drive(0.0, -30.0, speed=8.0, yaw=0.3)),
        thing("turning", turning(40.0, 10.0, radius=15.0, speed=6.0)),
        thing("late", drive(60.0, -8.0, speed=3.0, yaw=-2.0, first=20, last=40)),
    ]
    ego = on_the_ground(drive(0.0, 0.0, speed=10.0))
    ground = fit_scene_ground(GaussianCloud.empty(), ego, objects)
    return SimpleNamespace(objects=objects, ego=ego, ground=ground, coverage=None)


@pytest.fixture(scope="session")
def state(summary: SimpleNamespace) -> ScenarioState:
    return ScenarioState.of(summary)


@pytest.fixture(scope="session")
def state_with_assets(summary: SimpleNamespace) -> ScenarioState:
    """The same, with an asset library that contains a van."""
    van = SimpleNamespace(
        asset_id="van", category="truck", size=(5.0, 2.1, 2.0), gaussians=7, figure=None
    )
    return ScenarioState.of(summary, assets={"van": van}.get)
