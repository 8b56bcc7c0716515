"""Gaussians follow the particles of their body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from real2sim_server.geometry import quaternion_to_matrix
from real2sim_server.physics import Body, FixedCorotated, Solver, SolverOptions, box_particles
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.scene import GaussianCloud
from real2sim_server.simulation.damage import _split
from real2sim_server.simulation.particles import Deformed, Embedding, deform_cloud, replaced_rows
from real2sim_server.simulation.rigid import rotation_of


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


def test_dented_gaussians_keep_their_uncertainties():
    cloud = random_cloud(np.random.default_rng(2))
    cloud = replace(cloud, uncertainties=torch.linspace(0, 1, len(cloud)))
    still = np.repeat(np.eye(3)[None], len(cloud), axis=0)
    moved = deform_cloud(cloud, Deformed(cloud.means.numpy() + 0.1, 1.1 * still, still))
    assert torch.equal(moved.uncertainties, cloud.uncertainties)
    rows = torch.arange(5)
    part = replaced_rows(cloud, rows, moved.select(rows))
    assert torch.equal(part.uncertainties, cloud.uncertainties)
    assert torch.equal(part.means[:5], moved.means[:5])


def test_gaussians_split_by_a_dent_inherit_the_uncertainty():
    cloud = random_cloud(np.random.default_rng(2), 6)
    cloud = replace(cloud, uncertainties=torch.linspace(0, 1, 6))
    stretched = np.repeat(np.diag([5.0, 1, 1])[None], 2, axis=0)
    split = _split(cloud, np.array([1, 4]), stretched)
    assert torch.equal(split.uncertainties[6:], cloud.uncertainties[[1, 4]])


def test_rotating_the_matter_rotates_the_cloud_including_its_colours():
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


def test_gaussians_follow_the_solvers_total_deformation():
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


def test_a_gaussian_across_a_tear_is_not_stretched_into_a_sheet():
    rest = lattice().positions
    torn = np.where(rest[:, :1] > 0, [[5.0, 0, 0]], [[0.0, 0, 0]])
    cloud = random_cloud(np.random.default_rng(2))
    embedding = Embedding(rest, cloud.means.numpy().astype(np.float64), spacing=0.1)
    moved = deform_cloud(cloud, embedding.follow(torn))
    assert moved.scales.max() <= 2.0 * cloud.scales.max() + 1e-6
