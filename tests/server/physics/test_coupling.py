"""Gaussians follow matter; matter turns from rigid to deforming and back without a jolt."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.geometry.rotation import quaternion_to_matrix
from real2sim_server.physics import (
    Body,
    FixedCorotated,
    Plane,
    Solver,
    SolverOptions,
    box_particles,
)
from real2sim_server.scene import GaussianCloud
from real2sim_server.simulation.body import RIGID, SLEEPING, DeformableBody
from real2sim_server.simulation.embedding import Embedding, deform_cloud
from real2sim_server.simulation.rigid import RigidMotion, inertia_about, rotation_of
from real2sim_server.simulation.tyres import Tyres

from .scenes import at

GRAVITY = np.array([0.0, 0.0, -9.81])


def lattice(size=(1.0, 0.6, 0.4), spacing=0.1):
    return box_particles(size, spacing=spacing, density=200.0)


def random_cloud(rng, count=40, sh_degree=2) -> GaussianCloud:
    quats = torch.from_numpy(rng.normal(size=(count, 4))).float()
    return GaussianCloud(
        torch.from_numpy(rng.uniform(-0.18, 0.18, size=(count, 3))).float(),
        quats / quats.norm(dim=1, keepdim=True),
        torch.from_numpy(rng.uniform(0.01, 0.05, size=(count, 3))).float(),
        torch.from_numpy(rng.uniform(0.2, 1, size=count)).float(),
        torch.from_numpy(rng.normal(size=(count, (sh_degree + 1) ** 2, 3))).float(),
    )


def covariances(cloud: GaussianCloud) -> np.ndarray:
    axes = quaternion_to_matrix(cloud.quats.numpy()) * cloud.scales.numpy()[:, None, :]
    return axes @ np.swapaxes(axes, 1, 2)


def test_an_affine_motion_moves_means_and_covariances_exactly():
    rng = np.random.default_rng(0)
    rest, cloud = lattice().positions, random_cloud(rng)
    means = cloud.means.numpy().astype(np.float64)
    F = np.eye(3) + 0.2 * rng.normal(size=(3, 3))
    shift = np.array([1.0, -2.0, 0.5])
    deformed = Embedding(rest, means, spacing=0.1).follow(rest @ F.T + shift - rest)
    moved = deform_cloud(cloud, deformed)
    np.testing.assert_allclose(moved.means.numpy(), means @ F.T + shift, atol=1e-5)
    expected = F @ covariances(cloud) @ F.T
    np.testing.assert_allclose(covariances(moved), expected, atol=1e-7)
    assert torch.equal(moved.opacities, cloud.opacities)


def test_a_rotation_of_the_matter_is_a_rotation_of_the_cloud_colours_included():
    rng = np.random.default_rng(1)
    rest, cloud = lattice().positions, random_cloud(rng, sh_degree=3)
    pose = at(0.3, 0.1, 0.2)
    pose[:3, :3] = rotation_of(np.array([0.4, -0.3, 0.9]))
    embedding = Embedding(rest, cloud.means.numpy().astype(np.float64), spacing=0.1)
    turned = rest @ pose[:3, :3].T + pose[:3, 3]
    moved, expected = deform_cloud(cloud, embedding.follow(turned - rest)), cloud.moved(pose)
    np.testing.assert_allclose(moved.means.numpy(), expected.means.numpy(), atol=1e-5)
    np.testing.assert_allclose(moved.sh.numpy(), expected.sh.numpy(), atol=1e-4)
    np.testing.assert_allclose(covariances(moved), covariances(expected), atol=1e-7)


def test_gaussians_follow_the_total_deformation_that_the_solver_has():
    particles = lattice(size=(0.8, 0.8, 0.8), spacing=0.08)
    x = particles.positions
    velocities = np.stack([-0.8 * x[:, 0], 0.3 * x[:, 0] + 0.2 * x[:, 1], 0.1 * x[:, 2]], axis=1)
    body = Body(
        name="block",
        particles=particles,
        material=FixedCorotated(young=1.0, poisson=0.2),
        particle_velocities=velocities,
        particle_gradients=np.tile(
            [[-0.8, 0, 0], [0.3, 0.2, 0], [0, 0, 0.1]], (len(particles), 1, 1)
        ),
    )
    solver = Solver([body], (), SolverOptions(dx=0.16, gravity=(0, 0, 0), precision="double"))
    solver.step(0.3)
    state = solver.state("block")
    deep = (np.abs(x) < 0.2).all(axis=1)
    followed = Embedding(x, x[deep], spacing=0.08).follow(state.positions - x)
    np.testing.assert_allclose(followed.F, state.F_total[deep], atol=0.02)
    np.testing.assert_allclose(followed.positions, state.positions[deep], atol=2e-3)


def test_a_gaussian_across_a_tear_does_not_become_a_sheet():
    rest = lattice().positions
    torn = np.where(rest[:, :1] > 0, [[5.0, 0, 0]], [[0.0, 0, 0]])
    cloud = random_cloud(np.random.default_rng(2))
    embedding = Embedding(rest, cloud.means.numpy().astype(np.float64), spacing=0.1)
    moved = deform_cloud(cloud, embedding.follow(torn))
    assert moved.scales.max() <= 2.0 * cloud.scales.max() + 1e-6


def thrown(**options) -> DeformableBody:
    pose = at(0.2, 0.1, 2.0)
    pose[:3, :3] = rotation_of(np.array([0.2, 0.5, -0.4]))
    settings = {
        "friction": 0.4,
        "cell": 0.2,
        "T_world_object": pose,
        "velocity": np.array([3.0, -1.0, 0.5]),
        "angular_velocity": np.array([0.7, 1.5, -2.0]),
    }
    particles = lattice()
    regions = np.zeros(len(particles), dtype=np.int64)
    return DeformableBody(
        "box", particles, [FixedCorotated(young=2e6)], regions, **{**settings, **options}
    )


def loose(actor: DeformableBody) -> Solver:
    actor.loosen()
    options = SolverOptions(dx=actor.cell, gravity=(0, 0, 0), precision="double")
    return Solver([actor.body()], (), options)


def test_becoming_matter_keeps_momentum_angular_momentum_and_pose():
    actor = thrown()
    before, pose = actor.motion, actor.T_world_object
    solver = loose(actor)
    actor.take(solver.state("box"))
    np.testing.assert_allclose(actor.motion.momentum, before.momentum, rtol=1e-9)
    np.testing.assert_allclose(actor.motion.angular_momentum, before.angular_momentum, rtol=1e-9)
    np.testing.assert_allclose(actor.motion.angular_velocity, before.angular_velocity, rtol=1e-9)
    np.testing.assert_allclose(actor.T_world_object, pose, atol=1e-9)


def test_becoming_rigid_again_keeps_momentum_angular_momentum_pose_and_every_particle():
    actor = thrown()
    solver = loose(actor)
    solver.step(0.02)
    actor.take(solver.state("box"))
    motion, pose, points = actor.motion, actor.T_world_object, actor.state.positions
    spin = actor.state.angular_momentum
    actor.stiffen(RIGID)
    np.testing.assert_allclose(actor.motion.momentum, motion.momentum, rtol=1e-12)
    np.testing.assert_allclose(actor.motion.angular_momentum, spin, rtol=1e-9)
    np.testing.assert_allclose(actor.T_world_object, pose, atol=1e-12)
    again = actor.body().particles.positions
    np.testing.assert_allclose(again, points, atol=1e-12)


def test_laid_to_rest_it_stands_still():
    actor = thrown()
    solver = loose(actor)
    actor.take(solver.state("box"))
    actor.stiffen(SLEEPING)
    assert actor.motion.kinetic == 0


def test_a_free_rigid_body_keeps_its_angular_momentum_and_falls_like_a_stone():
    motion = thrown().motion
    spin = motion.angular_momentum
    height, speed = motion.centre[2], motion.velocity[2]
    for _ in range(200):
        motion = motion.falling(0.005, GRAVITY).moved(0.005)
    np.testing.assert_allclose(motion.angular_momentum, spin, rtol=1e-9)
    fallen = height + speed - 9.81 / 2 * 1.0 * (1.0 + 0.005)
    assert motion.centre[2] == pytest.approx(fallen, abs=1e-9)


SIZE = (4.5, 1.8, 1.5)


def car(speed: float, *, brake: float, mu=0.7) -> tuple[RigidMotion, Tyres]:
    particles = box_particles(SIZE, spacing=0.15, density=1500 / 12.15)
    centre = np.array([0.0, 0.0, -0.2])
    inertia = inertia_about(np.zeros(3), particles.positions, particles.masses, cell=0.2)
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
        motion = motion.falling(dt, GRAVITY)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = motion.rotation, motion.centre - motion.rotation @ offset
        motion = tyres.act(motion, pose, road, dt)[0].moved(dt)
    return motion


def test_braking_from_10_metres_a_second_takes_the_distance_of_coulomb():
    start, tyres = car(10.0, brake=1.0)
    end = drive(start, tyres, 3.0)
    assert end.centre[0] - start.centre[0] == pytest.approx(10**2 / (2 * 0.7 * 9.81), rel=0.03)
    assert np.linalg.norm(end.velocity) < 0.01
    assert end.centre[2] == pytest.approx(start.centre[2], abs=0.02)


def test_free_wheels_roll_on():
    start, tyres = car(10.0, brake=0.0)
    end = drive(start, tyres, 1.0)
    assert end.velocity[0] == pytest.approx(10 - 0.015 * 9.81, abs=0.05)


def test_free_wheels_do_not_slip_sideways_below_their_grip():
    start, tyres = car(0.0, brake=0.0)
    pushed = start.pushed(np.array([0, 1500 * 0.3, 0]), start.centre - [0, 0, 0.5])
    assert abs(drive(pushed, tyres, 1.0).velocity[1]) < 0.02


def test_the_body_hangs_on_its_wheels_as_it_stands():
    start, tyres = car(0.0, brake=1.0)
    end = drive(start, tyres, 2.0)
    np.testing.assert_allclose(end.centre, start.centre, atol=2e-3)


def test_wheels_go_up_into_the_body_as_far_as_it_came_down():
    size = (4.0, 1.8, 1.5)
    tyres = Tyres.of(size, np.zeros(3), 1e4)
    ground = Plane(name="ground")
    np.testing.assert_allclose(tyres.lifts(at(0, 0, 0.75), [ground]), 0.0, atol=1e-12)
    np.testing.assert_allclose(tyres.lifts(at(0, 0, 1.5), [ground]), 0.0, atol=1e-12)
    np.testing.assert_allclose(tyres.lifts(at(0, 0, 0.65), [ground]), 0.1)
    assert (tyres.lifts(at(0, 0, -3.0), [ground]) <= 0.3).all()
