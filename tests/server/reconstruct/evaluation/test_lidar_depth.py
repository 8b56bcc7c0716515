from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.reconstruct.evaluation.lidar import (
    depth_errors,
    error_p90,
    median_error,
    seen_points,
)
from real2sim_server.reconstruct.logged_view import points_in_camera
from real2sim_server.scene import Camera

from ..conftest import WALL_X, painted_log

K = np.array([[150.0, 0, 150], [0, 150, 100], [0, 0, 1]])
CAMERA = Camera("front", 300, 200, K, np.eye(4))


def wall(depth: float, *, reach: float = 4.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-reach, reach, 0.03), np.arange(-reach, reach, 0.03))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1)


def test_the_error_of_a_plane_is_its_depth_offset():
    depth = np.full((200, 300), 10.25, np.float32)
    errors = depth_errors(depth, wall(10.0), CAMERA)
    assert len(errors) > 1000
    np.testing.assert_allclose(errors, 0.25, atol=1e-5)


def test_a_slope_is_compared_at_the_depth_of_each_point():
    # The road 1.5 m below the camera: z = 1.5 f / (v - cy) at each pixel centre.
    z = np.linspace(3, 30, 300)
    points = np.stack([np.zeros_like(z), np.full_like(z, 1.5), z], axis=1)
    rows = np.arange(200) + 0.5 - 100
    true_depth = np.where(rows > 0, 1.5 * 150 / np.maximum(rows, 1e-9), 0)
    depth = np.repeat(true_depth[:, None], 300, axis=1).astype(np.float32)
    errors = depth_errors(depth, points, CAMERA)
    # The error of half a row is z^2 / (h f) / 2.
    assert errors.max() <= (z**2 / (1.5 * 150) / 2).max() * 1.1
    assert median_error(errors) < 0.4


def test_holes_count_as_infinite_errors():
    depth = np.full((200, 300), 10.0, np.float32)
    depth[:, :150] = 0
    errors = depth_errors(depth, wall(10.0), CAMERA)
    assert np.isinf(errors).mean() == pytest.approx(0.5, abs=0.02)
    depth[:, :200] = 0
    assert median_error(depth_errors(depth, wall(10.0), CAMERA)) == float("inf")


def test_occluded_points_are_ignored():
    near, far = wall(5.0, reach=1.0), wall(20.0, reach=15.0)
    rows, columns, depths = seen_points(np.concatenate([near, far]), CAMERA)
    assert (depths == 5.0).sum() == len(near)
    covered = (abs(columns - 150) < 28) & (abs(rows - 100) < 28)
    assert (depths[covered] == 5.0).all()
    assert (depths == 20.0).any()


def test_a_receding_road_does_not_occlude_itself():
    x, z = np.meshgrid(np.arange(-3, 3, 0.2), np.arange(3, 40, 0.5))
    road = np.stack([x.ravel(), np.full(x.size, 1.6), z.ravel()], axis=1)
    inside = np.abs(road[:, 0] / road[:, 2]) < 1
    _, _, depths = seen_points(road, CAMERA)
    assert len(depths) > 0.95 * (inside & (1.6 * 150 / road[:, 2] < 100)).sum()


def test_points_behind_the_camera_or_out_of_range_are_ignored():
    points = np.array([[0, 0, -5.0], [0, 0, 0.2], [0, 0, 100.0]])
    assert len(depth_errors(np.ones((200, 300), np.float32), points, CAMERA)) == 0
    assert np.isnan(median_error(np.zeros(0)))


def test_a_sweep_is_transformed_to_the_camera_frame():
    log = painted_log(boxes=False, frames=2)
    points = points_in_camera(log, log.rig["front"], 1, int(log.frame_times_us[1]))
    assert points[:, 2].max() == pytest.approx(WALL_X)
    assert points[:, 1].max() == pytest.approx(1.6, abs=1e-5)


def test_error_p90_is_the_90th_percentile():
    errors = np.arange(1.0, 101.0)
    assert error_p90(errors) == 90
    assert error_p90(np.append(np.zeros(9), 5.0)) == 0


def test_more_than_a_tenth_of_holes_makes_p90_infinite():
    few, many = np.zeros(100), np.zeros(100)
    few[:10] = many[:11] = np.inf
    assert error_p90(few) == 0
    assert error_p90(many) == np.inf
    assert np.isnan(error_p90(np.zeros(0)))
