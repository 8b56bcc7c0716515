"""Rigid motion, alone and on four tyres."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.physics import FixedCorotated, HeightField, Plane, box_particles
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.body import BodyMode, DeformableBody
from real2sim_server.simulation.rigid import RigidMotion, rotation_of
from real2sim_server.simulation.simulator import HybridSimulator
from real2sim_server.simulation.tyres import Tyres

GRAVITY = np.array([0.0, 0.0, -9.81])


def spinning() -> RigidMotion:
    return RigidMotion(
        rotation_of(np.array([0.2, 0.5, -0.4])),
        np.array([0.2, 0.1, 2.0]),
        np.array([3.0, -1.0, 0.5]),
        np.array([0.7, 1.5, -2.0]),
        48.0,
        np.diag([2.0, 5.0, 6.0]),
    )


def test_a_free_rigid_body_keeps_angular_momentum_and_falls_freely():
    motion = spinning()
    spin = motion.angular_momentum
    height, speed = motion.centre[2], motion.velocity[2]
    for _ in range(200):
        motion = motion.with_gravity(0.005, GRAVITY).advanced(0.005)
    np.testing.assert_allclose(motion.angular_momentum, spin, rtol=1e-9)
    fallen = height + speed - 9.81 / 2 * 1.0 * (1.0 + 0.005)
    assert motion.centre[2] == pytest.approx(fallen, abs=1e-9)


SIZE = (4.5, 1.8, 1.5)


def car(speed: float, *, brake: float, mu=0.7) -> tuple[RigidMotion, Tyres]:
    particles = box_particles(SIZE, spacing=0.15, density=1500 / 12.15)
    centre = np.array([0.0, 0.0, -0.2])
    inertia = particles.inertia
    motion = RigidMotion(
        np.eye(3),
        centre + np.array([0, 0, 0.75]),
        np.array([speed, 0, 0]),
        np.zeros(3),
        1500.0,
        inertia,
    )
    return motion, Tyres.of(SIZE, centre, 1500 * 9.81, friction=mu, brake=brake)


def drive(motion: RigidMotion, tyres: Tyres, seconds: float, *, dt=0.0025) -> RigidMotion:
    road = [Plane(name="ground")]
    offset = np.array([0.0, 0.0, -0.2])
    for _ in range(round(seconds / dt)):
        motion = motion.with_gravity(dt, GRAVITY)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = motion.rotation, motion.centre - motion.rotation @ offset
        motion = tyres.apply(motion, pose, road, dt)[0].advanced(dt)
    return motion


def test_braking_distance_from_10_m_s_follows_coulombs_law():
    start, tyres = car(10.0, brake=1.0)
    end = drive(start, tyres, 3.0)
    assert end.centre[0] - start.centre[0] == pytest.approx(10**2 / (2 * 0.7 * 9.81), rel=0.03)
    assert np.linalg.norm(end.velocity) < 0.01
    assert end.centre[2] == pytest.approx(start.centre[2], abs=0.02)


def test_free_wheels_keep_rolling():
    start, tyres = car(10.0, brake=0.0)
    end = drive(start, tyres, 1.0)
    assert end.velocity[0] == pytest.approx(10 - 0.015 * 9.81, abs=0.05)


def test_free_wheels_do_not_slide_sideways_below_their_grip():
    start, tyres = car(0.0, brake=0.0)
    pushed = start.with_impulse(np.array([0, 1500 * 0.3, 0]), start.centre - [0, 0, 0.5])
    assert abs(drive(pushed, tyres, 1.0).velocity[1]) < 0.02


def test_suspension_starts_at_rest():
    start, tyres = car(0.0, brake=1.0)
    end = drive(start, tyres, 2.0)
    np.testing.assert_allclose(end.centre, start.centre, atol=2e-3)


def test_wheels_move_into_the_body_as_far_as_it_sinks():
    size = (4.0, 1.8, 1.5)
    tyres = Tyres.of(size, np.zeros(3), 1e4)
    ground = Plane(name="ground")
    np.testing.assert_allclose(tyres.lifts(at(0, 0, 0.75), [ground]), 0.0, atol=1e-12)
    np.testing.assert_allclose(tyres.lifts(at(0, 0, 1.5), [ground]), 0.0, atol=1e-12)
    np.testing.assert_allclose(tyres.lifts(at(0, 0, 0.65), [ground]), 0.1)
    assert (tyres.lifts(at(0, 0, -3.0), [ground]) <= 0.3).all()


def test_a_rolling_car_stays_rigid_and_slows_by_rolling_resistance():
    motion, tyres = car(10.0, brake=0.0)
    particles = box_particles((4.5, 1.8, 1.3), spacing=0.1, density=100).moved(at(0, 0, 0.1))
    rolling = DeformableBody(
        "car",
        particles.with_mass(motion.mass),
        [FixedCorotated(young=2e7)],
        np.zeros(len(particles), dtype=np.int64),
        friction=0.4,
        cell=0.2,
        T_world_object=at(0, 0, SIZE[2] / 2),
        velocity=motion.velocity,
        angular_velocity=np.zeros(3),
        tyres=tyres,
    )
    ground = HeightField(name="ground", heights=np.zeros((200, 200)), origin=(-50, -50))
    simulated = HybridSimulator(
        [rolling], [ground], road=("ground",), gravity=(0, 0, -9.81), backend="cpu",
        brake_after_hit=1.0,
    )  # fmt: skip
    for _ in range(201):
        simulated.advance(0.005)
    assert rolling.mode == BodyMode.RIGID
    assert rolling.motion.velocity[0] == pytest.approx(10 - 0.015 * 9.81 * 1.005, abs=0.02)
