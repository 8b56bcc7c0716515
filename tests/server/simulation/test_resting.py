"""Settled bodies are carried by rigid contacts: they do not sink, creep or flip."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.physics import Box, Foam, Plane, box_particles
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.body import BodyMode, DeformableBody
from real2sim_server.simulation.resting import RestingContacts
from real2sim_server.simulation.rigid import rotation_of
from real2sim_server.simulation.simulator import STEP, HybridSimulator
from real2sim_server.simulation.structure import preset_of
from real2sim_server.simulation.tyres import Tyres

SIDE = 0.6
FOAM = Foam(young=4e5, poisson=0.3, yield_stress=3e4, plastic_viscosity=2e3, viscosity=400)
MU = 0.5


def box(name: str, pose, velocity=(0.0, 0.0, 0.0)) -> DeformableBody:
    particles = box_particles((SIDE, SIDE, SIDE), spacing=0.1, density=200.0)
    return DeformableBody(
        name,
        particles,
        [FOAM],
        np.zeros(len(particles), dtype=np.int64),
        friction=MU,
        cell=0.2,
        T_world_object=pose,
        velocity=np.array(velocity),
        angular_velocity=np.zeros(3),
    )


def simulator(*bodies: DeformableBody) -> HybridSimulator:
    return HybridSimulator(
        bodies,
        [Plane(name="ground")],
        road=["ground"],
        gravity=(0.0, 0.0, -9.81),
        backend="cpu",
        brake_after_hit=1.0,
    )


def run(world: HybridSimulator, seconds: float) -> int:
    """Continue, and count how often bodies start to deform."""
    begun, modes = 0, [b.mode for b in world.bodies]
    for _ in range(round(seconds / STEP)):
        world.advance(STEP)
        now = [b.mode for b in world.bodies]
        begun += sum(m == BodyMode.DEFORMING != k for m, k in zip(now, modes, strict=True))
        modes = now
    return begun


def places(world: HybridSimulator) -> np.ndarray:
    return np.stack([b.motion.centre for b in world.bodies])


def dropped(offset: float) -> HybridSimulator:
    """Three boxes stacked with 6 cm gaps, the second one offset sideways."""
    aside = {"a": 0.0, "b": offset, "c": 0.0}
    return simulator(*(box(n, at(x, 0, 0.36 + 0.66 * k)) for k, (n, x) in enumerate(aside.items())))


def test_a_collapsing_stack_comes_to_rest():
    world = dropped(0.02)
    assert run(world, 0.5) == 3
    settled = places(world)
    assert run(world, 0.5) == 0
    assert all(b.mode == BodyMode.SLEEPING for b in world.bodies)
    assert places(world) == pytest.approx(settled, abs=5e-4)
    assert np.abs(places(world)[:, :2]).max() < 0.04
    assert np.diff(places(world)[:, 2]).min() > 0.9 * SIDE


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, 0.02, 0.05])
def test_stacks_stay_put_for_five_seconds(offset):
    world = dropped(offset)
    run(world, 1.0)
    settled = places(world)
    assert run(world, 4.0) == 0
    assert places(world) == pytest.approx(settled, abs=1e-3)


def test_the_ground_and_each_box_carry_what_is_above():
    world = dropped(0.02)
    run(world, 0.45)
    before = world.contact_log.totals()
    assert all(b.mode == BodyMode.RIGID for b in world.bodies)
    run(world, 0.1)
    after = world.contact_log.totals()
    weight = 9.81 * world.bodies[0].motion.mass
    for pair, carried in ((("a", "ground"), 3), (("b", "a"), 2), (("c", "b"), 1)):
        force = (after[pair] - before[pair])[2] / 0.1
        assert force == pytest.approx(carried * weight, rel=0.1)
    for body in world.bodies:
        assert np.abs([body.motion.velocity, body.motion.angular_velocity]).max() < 5e-3


def test_a_box_slides_as_far_as_friction_allows():
    world = simulator(box("box", at(0, 0, SIDE / 2), (3.0, 0.0, 0.0)))
    run(world, 1.0)
    assert places(world)[0, 0] == pytest.approx(3.0**2 / (2 * MU * 9.81), rel=0.08)
    assert world.bodies[0].mode == BodyMode.SLEEPING


def test_a_toppled_box_ends_flat_on_the_ground():
    leant = np.eye(4)
    leant[:3, :3] = rotation_of(np.array([0.0, np.radians(65), 0.0]))
    leant[2, 3] = SIDE * np.sqrt(0.5) * np.cos(np.radians(20))
    world = simulator(box("box", leant))
    run(world, 2.0)
    assert world.bodies[0].mode == BodyMode.SLEEPING
    axes = world.bodies[0].T_world_object[:3, :3]
    assert np.abs(axes).max(axis=0) == pytest.approx(np.ones(3), abs=0.02)
    assert places(world)[0, 2] == pytest.approx(SIDE / 2, abs=0.02)


def test_a_slow_collider_moves_a_resting_box():
    """A wall moving too slowly to break contacts pushes a sleeping box."""
    world = simulator(box("box", at(0, 0, SIDE / 2)))
    run(world, 0.05)
    wall = Box(name="wall", T_world_box=at(-0.45, 0, 0.3), size=(0.2, 2, 0.6), velocity=(0.1, 0, 0))
    world.colliders.append(wall)
    run(world, 0.9)
    face = float(np.asarray(world.colliders[1].T_world_box)[0, 3]) + 0.1
    assert places(world)[0, 0] > face + 0.85 * SIDE / 2


@pytest.mark.slow
def test_a_car_on_a_car_comes_to_rest():
    """One vehicle dropped onto another's roof: after five seconds, below 1 mm/s."""
    world = simulator(car("under", 0.0, 0.75), car("over", 0.3, 2.2))
    run(world, 4.0)
    settled = places(world)
    assert run(world, 1.0) == 0
    assert places(world) == pytest.approx(settled, abs=1e-3)


def car(name: str, x: float, height: float) -> DeformableBody:
    size = (4.4, 1.8, 1.5)
    filled = box_particles((4.4, 1.8, 1.3), spacing=0.1, density=120.0).moved(at(0, 0, 0.1))
    materials, regions, particles = preset_of("vehicle").build("car", filled, 0.1)
    weight = 9.81 * particles.mass
    return DeformableBody(
        name,
        particles,
        materials,
        regions,
        friction=0.4,
        cell=0.2,
        T_world_object=at(x, 0, height),
        velocity=np.zeros(3),
        angular_velocity=np.zeros(3),
        tyres=Tyres.of(size, particles.centre_of_mass, weight, brake=1.0),
    )


def test_a_body_still_being_stopped_by_a_wall_is_not_at_rest():
    """A soft body that hits slowly is slow and keeps its shape long before it bounces."""
    wall = Plane(name="wall", point=(SIDE / 2, 0, 0), normal=(-1, 0, 0))
    body = box("body", at(0, 0, 0), velocity=(0.2, 0.0, 0.0))
    body.acceleration = np.array([-10.0, 0.0, 0.0])
    assert RestingContacts().begin(body, [wall], []) is False
    body.acceleration = np.array([0.0, -4.0, 0.0])
    assert RestingContacts().begin(body, [wall], []) is True
