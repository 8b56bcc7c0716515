"""A body stands only where its contact forces hold it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_server.physics import Box, Collider, FixedCorotated, Plane, box_particles
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.body import BodyMode, DeformableBody
from real2sim_server.simulation.rigid import rotation_of
from real2sim_server.simulation.simulator import HybridSimulator
from real2sim_server.simulation.tyres import Tyres

MU = 0.5
FRICTION_ANGLE = math.degrees(math.atan(MU))
SLENDER = (0.6, 0.6, 1.2)
TIPPING_ANGLE = math.degrees(math.atan(SLENDER[0] / SLENDER[2]))
CAR = (4.4, 1.8, 1.5)
GROUND = Plane(name="ground")


def block(pose, size=(0.6, 0.4, 0.4), *, name="block", friction=MU, **options) -> DeformableBody:
    particles = box_particles(size, spacing=0.1, density=200.0)
    return DeformableBody(
        name,
        particles,
        [FixedCorotated(young=2e6)],
        np.zeros(len(particles), dtype=np.int64),
        friction=friction,
        cell=0.2,
        T_world_object=pose,
        velocity=np.zeros(3),
        angular_velocity=np.zeros(3),
        **options,
    )


def slope(degrees: float) -> tuple[np.ndarray, Plane]:
    """A frame whose x axis points down a slope through the origin, and the slope."""
    frame = np.eye(4)
    frame[:3, :3] = rotation_of(np.array([0.0, math.radians(degrees), 0.0]))
    return frame, Plane(name="ground", normal=frame[:3, 2])


def car(frame=None, *, height=0.0, friction=0.7) -> DeformableBody:
    pose = (np.eye(4) if frame is None else frame) @ at(0, 0, CAR[2] / 2 + height)
    particles = box_particles((4.4, 1.8, 1.3), spacing=0.1, density=100.0).moved(at(0, 0, 0.1))
    road = Plane(name="ground", normal=pose[:3, 2])
    tyres = Tyres.of(
        CAR, particles.centre_of_mass, 9.81 * particles.mass, friction=friction, brake=1.0
    )
    return DeformableBody(
        "car",
        particles,
        [FixedCorotated(young=2e7)],
        np.zeros(len(particles), dtype=np.int64),
        friction=0.4,
        cell=0.2,
        T_world_object=pose,
        velocity=np.zeros(3),
        angular_velocity=np.zeros(3),
        tyres=tyres.standing(pose, [road]),
    )


def simulator(*bodies: DeformableBody, colliders: list[Collider]) -> HybridSimulator:
    return HybridSimulator(
        bodies,
        colliders,
        road=("ground",),
        gravity=(0, 0, -9.81),
        backend="cpu",
        brake_after_hit=1.0,
    )


def sleeps(body: DeformableBody, *colliders: Collider) -> bool:
    simulator(body, colliders=list(colliders))
    return body.mode == BodyMode.SLEEPING


@pytest.mark.parametrize("off", [-10, -3, -1, 1, 3, 10])
def test_a_block_stands_on_a_slope_up_to_the_friction_angle(off):
    frame, ground = slope(FRICTION_ANGLE + off)
    assert sleeps(block(frame @ at(0, 0, 0.2)), ground) == (off < 0)


@pytest.mark.parametrize("off", [-10, -3, -1, 1, 3, 10])
def test_a_slender_block_stands_up_to_the_angle_at_which_it_tips(off):
    frame, ground = slope(TIPPING_ANGLE + off)
    tall = block(frame @ at(0, 0, SLENDER[2] / 2), SLENDER, friction=2.0)
    assert sleeps(tall, ground) == (off < 0)


@pytest.mark.parametrize("beyond", [-0.1, -0.02, 0.02, 0.6])
def test_a_beam_stays_while_its_centre_is_over_the_table(beyond):
    table = Box(name="table", T_world_box=at(-1, 0, -0.5), size=(2, 2, 1))
    beam = block(at(beyond, 0, 0.1), (2.0, 0.4, 0.2))
    assert sleeps(beam, table) == (beyond < 0)


@pytest.mark.parametrize(("height", "stands"), [(0.0, True), (0.05, False), (0.3, False)])
def test_a_body_that_touches_nothing_does_not_stand(height, stands):
    assert sleeps(block(at(0, 0, 0.2 + height)), GROUND) == stands


def test_a_box_on_a_steep_slope_slides_by_coulombs_law():
    frame, ground = slope(60)
    box = block(frame @ at(0, 0, 0.2), friction=0.1)
    simulated = simulator(box, colliders=[ground])
    start = box.motion.centre
    for _ in range(40):
        simulated.advance(0.005)
    pull = 9.81 * (math.sin(math.pi / 3) - 0.1 * math.cos(math.pi / 3))
    assert (box.motion.centre - start) @ frame[:3, 0] == pytest.approx(pull * 0.02, rel=0.1)


def test_a_car_above_the_road_falls_onto_its_wheels():
    above = car(height=0.35)
    simulated = simulator(above, colliders=[GROUND])
    assert above.mode == BodyMode.RIGID
    for _ in range(40):
        simulated.advance(0.005)
    assert above.motion.centre[2] < car(height=0.25).motion.centre[2]


def test_a_car_stands_on_a_slope_as_long_as_its_tyres_hold():
    for percent, stands in ((68, True), (72, False), (80, False)):
        frame, ground = slope(math.degrees(math.atan(percent / 100)))
        assert sleeps(car(frame), ground) == stands
    frame, ground = slope(math.degrees(math.atan(0.8)))
    sliding = car(frame)
    simulated = simulator(sliding, colliders=[ground])
    speeds = []
    for _ in range(400):
        simulated.advance(0.005)
        speeds.append(sliding.motion.velocity @ frame[:3, 0])
    # In the first second its springs adjust to the slope.
    angle = math.atan(0.8)
    pull = 9.81 * (math.sin(angle) - 0.7 * math.cos(angle))
    assert speeds[-1] - speeds[199] == pytest.approx(pull, rel=0.1)


def test_a_body_on_a_moving_support_does_not_sleep():
    table = Box(name="table", T_world_box=at(0, 0, -0.5), size=(2, 2, 1), velocity=(0, 0, -5))
    assert not sleeps(block(at(0, 0, 0.2)), table)


def test_a_body_wakes_when_its_support_is_removed():
    low, high = block(at(0, 0, 0.2), name="low"), block(at(0, 0, 0.6), name="high")
    simulated = simulator(low, high, colliders=[GROUND])
    assert low.mode == high.mode == BodyMode.SLEEPING
    assert high.supports == {"low"}
    low.wake()
    low.motion = low.motion.with_impulse(
        np.array([40.0 * low.motion.mass, 0, 0]), low.motion.centre
    )
    low.translate(np.array([1.0, 0.0, 0.0]))
    simulated.advance(0.005)
    assert high.mode != BodyMode.SLEEPING
