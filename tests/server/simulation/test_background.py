"""The scene's background stops what hits it, and the ego takes part as a body of its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.scene import CameraRig, GaussianCloud, Ground, Scene, SceneObject, Trajectory
from real2sim_server.scene.io import read_packed
from real2sim_server.simulation import ObjectPhysics, Playback, SimulateOptions, simulate
from real2sim_server.simulation.background import Cleared, background_colliders, ground_collider
from real2sim_server.simulation.body import BodyMode
from real2sim_server.simulation.spawn import EGO, with_ego

CRATE = (2.0, 1.2, 1.2)
TURN = 0.4
"""Of the house wall against the road [rad]."""
WALL = np.array([np.cos(TURN), np.sin(TURN)])
NORMAL = np.array([WALL[1], -WALL[0]])
"""Out of it, towards the road."""
FOOT = np.array([6.0, 7.0])
"""A place of its face."""


def cloud(points) -> GaussianCloud:
    means = torch.tensor(np.asarray(points), dtype=torch.float32)
    n = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return GaussianCloud(
        means, quats, torch.full((n, 3), 0.06), torch.full((n,), 0.9), torch.zeros((n, 1, 3))
    )


def surface(start, end, height, step=0.12) -> np.ndarray:
    """[N, 3] points of an upright surface between two positions in plan view."""
    start, end = np.array(start, float), np.array(end, float)
    along = np.linspace(0, 1, round(float(np.linalg.norm(end - start)) / step) + 1)
    up = np.arange(0.05, height, step)
    plan = start + along[:, None] * (end - start)
    return np.concatenate([np.column_stack([plan, np.full(len(plan), z)]) for z in up])


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A road along x, a house with two sides, a pole, and a crate between them."""
    corner = FOOT + 8 * WALL
    house = [
        surface(FOOT - 8 * WALL, corner, 3.0),
        surface(corner, corner - 4 * NORMAL, 3.0),
        surface((12.0, 2.5), (12.12, 2.5), 3.0, step=0.06),
    ]
    times = np.array([0, 2_000_000])
    upright = np.tile([1.0, 0, 0, 0], (2, 1))
    crate = cloud(np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3)) * CRATE)
    standing = Trajectory(times, np.tile([5.0, 3.0, 0.6], (2, 1)), upright)
    return Scene(
        name="corner",
        background=cloud(np.concatenate(house)),
        objects={"crate": SceneObject("crate", "crate", CRATE, crate, standing)},
        sky=None,
        rig=CameraRig(()),
        ego=Trajectory(times, np.array([[-4.0, 0, 0], [16.0, 0, 0]]), upright),
        frame_times_us=times,
        stored_ground=Ground.level(0.0),
    )


def colliders(scene, place=(5.0, 3.0, 0.6)):
    return background_colliders(scene, [Cleared(at(*place), np.array(CRATE))], within=30.0)


def covers(boxes, points) -> np.ndarray:
    """Which points [N, 2] are in one of the boxes."""
    found = np.zeros(len(points), dtype=bool)
    for box in boxes:
        pose = np.asarray(box.T_world_box)
        local = (points - pose[:2, 3]) @ pose[:2, :2]
        found |= np.all(np.abs(local) <= np.asarray(box.size)[:2] / 2 + 0.05, axis=1)
    return found


def test_house_sides_and_a_pole_become_boxes_where_they_were_seen(scene):
    boxes = colliders(scene)
    assert len(boxes) <= 8
    seen = scene.background.means.numpy().astype(np.float64)
    assert covers(boxes, seen[:, :2]).mean() > 0.97
    # Nothing stands in front of the wall's face, and the wall is thick behind it.
    along = FOOT + np.linspace(-7, 6, 30)[:, None] * WALL
    assert not covers(boxes, along + 0.25 * NORMAL).any()
    assert covers(boxes, along - 0.3 * NORMAL).all()
    pole = min(boxes, key=lambda b: float(np.prod(np.asarray(b.size)[:2])))
    assert np.asarray(pole.size)[:2].max() < 0.3
    tops = [float(np.asarray(b.T_world_box)[2, 3] + np.asarray(b.size)[2] / 2) for b in boxes]
    assert tops == pytest.approx([2.9] * len(boxes), abs=0.2)


def test_no_background_box_overlaps_an_objects_start(scene):
    """Not even background that lies inside its own box."""
    place = (*(FOOT + 0.2 * NORMAL), 0.6)
    starts = Cleared(at(*place), np.array(CRATE))
    for box in colliders(scene, place):
        size, pose = np.asarray(box.size), np.asarray(box.T_world_box)
        u, v = np.meshgrid(*[np.linspace(-0.5, 0.5, 60)] * 2)
        inside = np.stack([u.ravel() * size[0], v.ravel() * size[1]], axis=1) @ pose[:2, :2].T
        assert not starts.holds(inside + pose[:2, 3]).any()


def crash(scene, state, name, velocity, **options):
    ground = ground_collider(scene.ground, np.array([[0.0, 0.0], [16.0, 10.0]]))
    return simulate(
        scene,
        state,
        SimulateOptions(
            objects={name: ObjectPhysics(velocity=velocity)},
            colliders=[ground],
            frame_rate=10,
            **options,
        ),
    )


@pytest.mark.parametrize("background", [True, False])
def test_a_block_sliding_into_a_house_stops_there(scene, background):
    state = ScenarioState.of(scene)
    velocity = (*(-8.0 * NORMAL), 0.0)
    result = crash(
        scene, state, "crate", velocity, duration=0.6, background=background, max_particles=800
    )
    own = result.objects["crate"]
    beyond = (own.positions[-1, :2] - FOOT) @ -NORMAL
    hit = {c.other for c in result.contacts if c.other.startswith("background.")}
    if not background:
        assert beyond > 0.2
        assert not hit
        assert "background" not in result.figures
        return
    assert beyond < -0.4
    assert float(own.velocities[-1, :2] @ -NORMAL) < 1.0
    assert hit <= {b["name"] for b in result.figures["background"]}
    assert hit


@pytest.mark.slow
def test_a_car_pushed_into_a_house_of_the_demo_street_stops_there():
    street = read_packed(SHIPPED)
    result = simulate(
        street,
        ScenarioState.of(street),
        SimulateOptions(
            objects={"car_4": ObjectPhysics(velocity=(0.0, 9.0, 0.0))},
            colliders=[ground_collider(street.ground, np.array([[9.4, 6.5]]), friction=0.7)],
            duration=1.0,
            background=True,
        ),
    )
    own = result.objects["car_4"]
    face = 11.0
    assert own.positions[-1, 1] < face - 0.4 * 1.82
    assert np.abs(own.velocities[-1]).max() < 1.5
    assert any(c.other.startswith("background.") and c.delta_v > 2 for c in result.contacts)


def test_the_ego_takes_part_and_is_visible(scene):
    complete, state = with_ego(scene, ScenarioState.of(scene))
    result = crash(complete, state, EGO, (0.0, 0.0, 0.0), duration=0.1, background=True)
    own = result.objects[EGO]
    assert own.positions[0] == pytest.approx([-4.0 + 4.6 / 2 - 0.95, 0.0, 0.8], abs=0.01)
    assert own.modes[-1] != BodyMode.DEFORMING
    assert own.mass == pytest.approx(125.0 * 4.6 * 1.85 * 1.6)
    shown = Playback(complete, state, result).instances(1)
    means = shown[-1].cloud.means.numpy()
    assert len(shown) == 3
    assert np.ptp(means, axis=0) == pytest.approx((4.6, 1.85, 1.6), abs=0.08)
    assert with_ego(complete, state) == (complete, state)
