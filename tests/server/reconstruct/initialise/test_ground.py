from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.geometry.transform import transform_from
from real2sim_server.reconstruct.initialise.ground import BoxBottoms, fit_ground, spread_ground
from real2sim_server.reconstruct.initialise.pull_push import pull_push

NO_BOXES = BoxBottoms(np.zeros((0, 3)), np.zeros((0, 4, 2)))
PATH = np.stack([transform_from([x, 0, 0], [1, 0, 0, 0]) for x in range(10)])


def slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.02 * y + 0.001 * x


def street(seed: int = 0) -> np.ndarray:
    """A tilted road with noise, a wall beside it, and reflections far below it."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-15, 25, 60_000), rng.uniform(-12, 12, 60_000)
    road = np.stack([x, y, slope(x, y) + rng.normal(0, 0.01, x.size)], axis=1)
    wall = np.stack([x[:8000], np.full(8000, 9.0), rng.uniform(0.3, 5, 8000)], axis=1)
    below = np.stack([x[:300], y[:300], np.full(300, -4.0)], axis=1)
    return np.concatenate([road, wall, below])


def test_heights_follow_the_road_in_spite_of_walls_and_reflections():
    surface = fit_ground(street(), PATH, NO_BOXES)
    xy = np.stack(np.meshgrid(np.arange(-10, 20, 0.5), np.arange(-8, 8, 0.5)), -1).reshape(-1, 2)
    np.testing.assert_allclose(surface.height_at(xy), slope(*xy.T), atol=0.03)
    assert surface.covers(xy).all()


def test_the_road_goes_on_under_a_box_that_hides_it():
    points = street()
    hidden = (np.abs(points[:, 0] - 12) < 3) & (np.abs(points[:, 1] + 4) < 1.5)
    corners = np.array([[9.0, -5.5], [15, -5.5], [15, -2.5], [9, -2.5]])
    bottoms = BoxBottoms(np.array([[12.0, -4.0, slope(12.0, -4.0)]]), corners[None])
    surface = fit_ground(points[~hidden], PATH, bottoms)
    xy = np.stack(np.meshgrid(np.arange(9.2, 15, 0.2), np.arange(-5.3, -2.6, 0.2)), -1)
    xy = xy.reshape(-1, 2)
    assert surface.covers(xy).all()
    np.testing.assert_allclose(surface.height_at(xy), slope(*xy.T), atol=0.05)


def test_ground_points_lie_on_the_surface_and_keep_to_the_limit():
    surface = fit_ground(street(), PATH, NO_BOXES)
    spread = spread_ground(surface, 0.1, 20_000)
    assert 5_000 < len(spread.points) <= 20_000
    xy = spread.points[:, :2].astype(np.float64)
    np.testing.assert_allclose(spread.points[:, 2], surface.height_at(xy), atol=1e-4)
    assert spread.normals[:, 2].min() > 0.9


def test_no_two_ground_points_share_a_place():
    surface = fit_ground(street(), PATH, NO_BOXES)
    points = spread_ground(surface, 0.1, 1_000_000).points
    assert len(np.unique(np.round(points[:, :2] / 0.01), axis=0)) == len(points)


def test_pull_push_keeps_what_is_known_and_stays_within_its_range():
    rng = np.random.default_rng(0)
    values = rng.uniform(2, 3, (13, 22, 2)).astype(np.float32)
    weights = (rng.uniform(size=(13, 22)) < 0.1).astype(np.float32)
    filled = pull_push(values, weights)
    np.testing.assert_array_equal(filled[weights == 1], values[weights == 1])
    assert filled.min() >= 2 - 1e-5
    assert filled.max() <= 3 + 1e-5


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (8, 8)])
def test_pull_push_of_a_constant_is_that_constant(shape):
    weights = np.zeros(shape, np.float32)
    weights[0, 0] = 1
    filled = pull_push(np.full((*shape, 1), 4, np.float32), weights)
    np.testing.assert_allclose(filled, 4, rtol=1e-6)
