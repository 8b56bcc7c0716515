from __future__ import annotations

import numpy as np

from real2sim_server.reconstruct.initialise.surfels import spread_ground
from real2sim_server.scene.ground_fit import BoxBottoms, DrivenPath, GroundFit, fit_ground


def road() -> GroundFit:
    """A tilted road with noise, driven along x."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-15, 25, 60_000), rng.uniform(-12, 12, 60_000)
    points = np.stack([x, y, 0.02 * y + 0.001 * x + rng.normal(0, 0.01, x.size)], axis=1)
    way = np.arange(0.0, 10.0)
    driven = np.stack([way, 0 * way, 0.001 * way], axis=1)
    up = np.tile(np.array([-0.001, -0.02, 1.0]) / np.linalg.norm([0.001, 0.02, 1.0]), (10, 1))
    path = DrivenPath(driven, up, driven[:, 2], up)
    return fit_ground(points, path, BoxBottoms(np.zeros((0, 3)), np.zeros((0, 4, 2))))


def test_ground_points_lie_on_the_surface_within_the_limit():
    fitted = road()
    spread = spread_ground(fitted, 0.1, 20_000)
    assert 5_000 < len(spread.points) <= 20_000
    xy = spread.points[:, :2].astype(np.float64)
    np.testing.assert_allclose(spread.points[:, 2], fitted.surface.height_at(xy), atol=1e-4)
    assert spread.normals[:, 2].min() > 0.9


def test_ground_points_are_unique():
    fitted = road()
    points = spread_ground(fitted, 0.1, 1_000_000).points
    assert len(np.unique(np.round(points[:, :2] / 0.01), axis=0)) == len(points)
