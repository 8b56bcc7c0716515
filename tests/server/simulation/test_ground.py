"""The road under boxes, among points that are not all road."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.physics import PhysicsError
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.ground import find_road
from real2sim_server.simulation.surroundings import clearance

BOXES = [(at(x, y, 1.0), (4.5, 1.8, 1.5)) for x, y in ((0, 0), (12, 3), (20, -2))]
EVERYWHERE = np.array([-12.0, -12.0]), np.array([32.0, 12.0])


def points(height, *, count=60_000, noise=0.01, clutter=0.1, seed=0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(*EVERYWHERE, size=(count, 2))
    z = height(xy[:, 0], xy[:, 1]) + noise * rng.normal(size=count)
    stands = rng.random(count) < clutter
    z[stands] += rng.uniform(0.2, 2.0, size=stands.sum())
    return np.column_stack([xy, z])


def slope(x, y):
    return 0.25 + 0.04 * x - 0.02 * y


def test_the_plane_is_that_of_the_road_and_not_of_what_stands_on_it():
    cloud = points(slope, clutter=0.4)
    road = find_road(cloud, BOXES)
    normal = np.array([-0.04, 0.02, 1.0]) / np.linalg.norm([-0.04, 0.02, 1.0])
    np.testing.assert_allclose(road.plane.normal, normal, atol=2e-3)
    assert abs(np.asarray(road.plane.normal) @ [0, 0, 0.25] - clearance_of_origin(road)) < 0.01
    looked_at = cloud[road.candidates]
    on_road = np.abs(looked_at[:, 2] - slope(*looked_at[:, :2].T)) < 0.08
    assert 0.7 < on_road.mean() < 0.99
    assert (road.inliers == on_road).mean() > 0.999


def clearance_of_origin(road) -> float:
    return -float(clearance(road.plane, np.zeros((1, 3)))[0][0])


def test_heights_follow_a_road_that_is_no_plane():
    def crown(x, y):
        return 0.3 * np.sin(x / 9) - 0.004 * y**2

    road = find_road(points(crown, clutter=0.05), BOXES)
    xy = np.stack(np.meshgrid(np.arange(-4.0, 24), np.arange(-6.0, 7)), axis=-1).reshape(-1, 2)
    truth = np.column_stack([xy, crown(*xy.T)])
    distance, normals = clearance(road.field, truth)
    assert np.abs(distance).max() < 0.08
    assert np.sqrt((distance**2).mean()) < 0.025
    assert normals[:, 2].min() > 0.95


def test_only_points_around_the_boxes_are_looked_at():
    cloud = points(slope)
    road = find_road(cloud, BOXES[:1])
    assert np.abs(cloud[road.candidates, 0]).max() < 2.25 + 2.5 + 1e-9


def test_the_same_points_give_the_same_road():
    cloud = points(slope)
    a, b = find_road(cloud, BOXES), find_road(cloud, BOXES)
    assert np.array_equal(a.field.heights, b.field.heights)


def test_nothing_under_the_boxes_is_refused():
    with pytest.raises(PhysicsError, match="0 of 5 points"):
        find_road(np.full((5, 3), 500.0), BOXES)
    with pytest.raises(PhysicsError, match="at least one"):
        find_road(points(slope), [])
