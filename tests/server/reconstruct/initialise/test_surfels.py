from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.reconstruct.initialise.surfels import fit_surfels


def grid(step_x: float, step_y: float, count: int = 20) -> np.ndarray:
    x, y = np.meshgrid(np.arange(count) * step_x, np.arange(count) * step_y, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float32)


def inner(points: np.ndarray) -> np.ndarray:
    low, high = points.min(0), points.max(0)
    fraction = (points[:, :2] - low[:2]) / (high - low)[:2]
    return ((fraction > 0.2) & (fraction < 0.8)).all(axis=1)


def test_gaussians_on_a_plane_are_flat():
    points = grid(0.1, 0.1)
    surfels = fit_surfels(points, largest=1.0, smallest=0.001)
    assert np.abs(surfels.normals[:, 2]).min() > 0.999
    assert (surfels.scales[:, 2] < 0.3 * surfels.scales[:, :2].min(axis=1)).all()


def test_axes_are_right_handed_rotations():
    points = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    axes = fit_surfels(points, largest=1.0).axes.astype(np.float64)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1) - np.eye(3), 0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(axes), 1, atol=1e-5)


def test_gaussians_stretch_across_scan_lines():
    points = grid(0.1, 0.3)
    surfels = fit_surfels(points, largest=1.0)
    covariance = np.einsum("nij,nj,nkj->nik", surfels.axes, surfels.scales**2, surfels.axes)
    along, across = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1])
    middle = inner(points)
    assert np.median(along[middle]) == pytest.approx(0.06, rel=0.2)
    assert np.median(across[middle]) == pytest.approx(0.18, rel=0.2)


def test_surfels_close_gaps_in_a_surface():
    points = grid(0.1, 0.2)
    surfels = fit_surfels(points, largest=1.0)
    covariance = np.einsum("nij,nj,nkj->nik", surfels.axes, surfels.scales**2, surfels.axes)
    centre = points.mean(axis=0)
    gap = np.array([np.floor(centre[0] / 0.1) * 0.1 + 0.05, np.floor(centre[1] / 0.2) * 0.2 + 0.1])
    offset = points[:, :2] - gap
    inverse = np.linalg.inv(covariance[:, :2, :2])
    alpha = 0.95 * np.exp(-0.5 * np.einsum("ni,nij,nj->n", offset, inverse, offset))
    assert 1 - np.prod(1 - alpha) > 0.9


def test_scales_stay_within_their_bounds():
    points = np.random.default_rng(1).uniform(0, 100, (200, 3)).astype(np.float32)
    scales = fit_surfels(points, largest=0.5, smallest=0.01).scales
    assert scales.max() <= 0.5
    assert scales.min() >= 0.01


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_points_become_isotropic_gaussians(count):
    points = np.arange(3 * count, dtype=np.float32).reshape(count, 3)
    surfels = fit_surfels(points, largest=0.2)
    assert (surfels.scales == np.float32(0.2)).all()
    assert surfels.quats.shape == (count, 4)
