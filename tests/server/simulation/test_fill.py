"""From Gaussians to particles: the inside, the volume, the mass."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.physics import ParticleError, box_particles
from real2sim_server.scene import GaussianCloud
from real2sim_server.simulation.particles import fill_object
from real2sim_server.simulation.structure import default_mass

SIZE = (2.0, 1.0, 0.8)


def shell_cloud(*, sides="all", step=0.05, size=SIZE) -> GaussianCloud:
    """Flat Gaussians on the faces of a box; ``sides`` leaves faces out."""
    points = []
    half = np.array(size) / 2
    for axis in range(3):
        for sign in (-1, 1):
            if sides == "no underside" and axis == 2 and sign < 0:
                continue
            others = [a for a in range(3) if a != axis]
            ticks = [np.arange(-half[a] + step / 2, half[a], step) for a in others]
            u, v = np.meshgrid(*ticks)
            face = np.empty((u.size, 3))
            face[:, others[0]], face[:, others[1]] = u.ravel(), v.ravel()
            face[:, axis] = sign * (half[axis] - 0.01)
            points.append(face)
    means = torch.from_numpy(np.concatenate(points)).float()
    n = len(means)
    return GaussianCloud(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.full((n, 3), 0.02),
        torch.full((n,), 0.9),
        torch.zeros(n, 1, 3),
    )


@pytest.mark.parametrize("sides", ["all", "no underside"])
def test_a_shell_is_filled_to_its_box_volume(sides):
    filling = fill_object(shell_cloud(sides=sides), SIZE, spacing=0.05, mass=320.0)
    particles = filling.particles
    assert particles.volumes.sum() == pytest.approx(1.6, rel=0.12)
    assert particles.mass == pytest.approx(320.0)
    np.testing.assert_allclose(particles.centre_of_mass, 0, atol=0.03)
    exact = 320 / 12 * np.array([1 + 0.64, 4 + 0.64, 4 + 1])
    np.testing.assert_allclose(np.diag(particles.inertia), exact, rtol=0.12)
    assert filling.sealed == (() if sides == "all" else ("-z",))


def test_gaussians_become_particles_and_the_rest_is_fill():
    cloud = shell_cloud()
    particles = fill_object(cloud, SIZE, spacing=0.05).particles
    own = particles.source >= 0
    assert own.sum() == len(cloud)
    np.testing.assert_allclose(
        particles.positions[own], cloud.means.numpy()[particles.source[own]], atol=1e-6
    )
    depth = (np.array(SIZE) / 2 - np.abs(particles.positions[~own])).min(axis=1)
    assert np.median(depth) > 0.1


def test_haze_and_strays_are_not_matter():
    cloud = shell_cloud()
    faint = GaussianCloud(
        cloud.means, cloud.quats, cloud.scales, torch.full_like(cloud.opacities, 0.01), cloud.sh
    )
    far = cloud.moved(np.array([[1, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    with pytest.raises(ParticleError, match="nothing to simulate"):
        fill_object(faint, SIZE, spacing=0.05)
    with pytest.raises(ParticleError, match="nothing to simulate"):
        fill_object(far, SIZE, spacing=0.05)
    both = fill_object(GaussianCloud.concatenate([cloud, far]), SIZE, spacing=0.05)
    assert both.particles.source.max() < len(cloud)


def test_mass_defaults_to_that_of_the_category():
    assert default_mass("car", (4.87, 1.85, 1.47)) == pytest.approx(1655, rel=0.01)
    particles = fill_object(shell_cloud(), SIZE, spacing=0.1, category="car").particles
    assert particles.mass == pytest.approx(default_mass("car", SIZE))


@pytest.mark.parametrize(
    ("category", "size", "mass"),
    [
        ("pedestrian", (0.5, 0.33, 1.75), 78.0),
        ("pedestrian", (0.9, 0.9, 1.75), 78.0),  # as wide as a box tracked while walking
        ("pedestrian", (0.5, 0.5, 1.1), 24.4),  # six years: 20.6 kg by the CDC's growth charts
        ("pedestrian", (1.0, 1.0, 3.0), 108.9),  # no more than for a height of two metres
        ("cyclist", (1.9, 0.9, 1.75), 92.0),
        ("motorcyclist", (2.2, 1.0, 1.75), 278.0),
    ],
)
def test_peoples_mass_depends_on_their_height(category, size, mass):
    assert default_mass(category, size) == pytest.approx(mass, abs=0.1)


@pytest.mark.parametrize("options", [{"spacing": 0}, {"spacing": 0.1, "mass": -1.0}])
def test_invalid_arguments_are_refused(options):
    with pytest.raises(ParticleError, match="must be positive"):
        fill_object(shell_cloud(), SIZE, **options)


def test_a_spacing_that_needs_too_much_memory_is_refused():
    with pytest.raises(ParticleError, match="GiB"):
        fill_object(shell_cloud(), SIZE, spacing=1e-4)


def test_a_lattice_has_the_inertia_of_its_box():
    box = box_particles(SIZE, spacing=0.1, density=100)
    assert box.mass == pytest.approx(160)
    exact = 160 / 12 * np.array([1 + 0.64, 4 + 0.64, 4 + 1])
    np.testing.assert_allclose(np.diag(box.inertia), exact, rtol=1e-9)
