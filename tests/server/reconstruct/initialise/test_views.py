from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_server.reconstruct.initialise import view_kernels as kernels
from real2sim_server.reconstruct.initialise.views import chosen_frames, nearest_objects

from ..conftest import painted_log

K = np.array([100, 100, 20, 20], np.float32)
TOWARDS_CAMERA = np.array([0, 0, -1], np.float32)


def splat(centre, radius, normal=TOWARDS_CAMERA) -> np.ndarray:
    depth = np.full((40, 40), np.inf, np.float32)
    kernels.splat_depth(
        np.array([centre], np.float32),
        np.array([normal], np.float32),
        np.array([radius], np.float32),
        K,
        depth,
    )
    return depth


def test_a_frontal_disk_covers_its_projection_at_its_depth():
    depth = splat((0, 0, 10), 1.0)
    v, u = np.indices(depth.shape) + 0.5
    inside = np.hypot(u - 20, v - 20) <= 10
    assert np.isfinite(depth[inside]).all()
    assert not np.isfinite(depth[np.hypot(u - 20, v - 20) > 11]).any()
    np.testing.assert_allclose(depth[np.isfinite(depth)], 10)


def test_a_slanted_disk_has_the_depth_of_its_plane():
    normal = np.array([0, -0.6, -0.8])
    depth = splat((0, 0, 10), 1.0, normal)
    rows, columns = np.nonzero(np.isfinite(depth))
    rays = np.stack([(columns + 0.5 - 20) / 100, (rows + 0.5 - 20) / 100, np.ones(len(rows))], 1)
    points = rays * depth[rows, columns][:, None]
    np.testing.assert_allclose((points - [0, 0, 10]) @ normal, 0, atol=1e-4)


def test_a_disk_smaller_than_a_pixel_still_covers_one():
    assert np.isfinite(splat((0.02, 0.02, 10), 1e-4)).sum() == 1


def test_disks_behind_the_camera_are_not_drawn():
    assert not np.isfinite(splat((0, 0, -5), 1.0)).any()


def test_the_nearest_two_objects_are_distinguished():
    near, far = (np.full((40, 60), np.inf, np.float32) for _ in range(2))
    far[10:30, 10:40] = 20
    near[10:30, 25:50] = 8
    first, instance, second = nearest_objects({1: far, 2: near}, 100.0, (40, 60))
    assert (instance[20, 15], first[20, 15], second[20, 15]) == (1, 20, np.inf)
    assert (instance[20, 32], first[20, 32], second[20, 32]) == (2, 8, 20)
    assert (instance[20, 45], first[20, 45], second[20, 45]) == (2, 8, np.inf)


def test_objects_are_dilated_by_a_margin():
    depth = np.full((60, 80), np.inf, np.float32)
    depth[25:35, 30:50] = 10
    first, instance, _ = nearest_objects({3: depth}, 100.0, (60, 80))
    assert instance[24, 40] == 3
    assert np.isinf(first[:20]).all()
    assert np.isinf(first[:, :25]).all()


@pytest.mark.parametrize(("limit", "expected"), [(1, [0]), (2, [0, 8]), (5, [0, 2, 4, 6, 8])])
def test_frames_are_spread_evenly_over_the_log(limit, expected):
    assert chosen_frames(painted_log(frames=9), limit) == expected


def test_all_frames_are_used_below_the_limit():
    assert chosen_frames(painted_log(frames=9), 100) == list(range(9))


def test_robust_mean_ignores_a_passing_car():
    colours = np.array([[[100] * 3, [104] * 3, [98] * 3, [240, 10, 10]]], np.uint8)
    weights = np.ones((1, 4), np.float32)
    result, known = np.zeros((1, 3), np.float32), np.zeros(1, np.bool_)
    kernels.robust_mean(colours, weights, result, known)
    assert known[0]
    np.testing.assert_allclose(result[0] * 255, 100.67, atol=0.1)


@pytest.mark.parametrize(
    ("instance", "slant", "sampled"), [(1, 0.1, False), (1, 0.3, True), (0, 0.1, True)]
)
def test_grazing_views_do_not_colour_objects(instance, slant, sampled):
    normal = np.array([[math.sqrt(1 - slant**2), 0, -slant]], np.float32)
    point, depth = np.array([[0, 0, 10]], np.float32), np.full((40, 40), 10, np.float32)
    nothing = np.full((40, 40), np.inf, np.float32)
    colours, weights = np.zeros((1, 2, 3), np.uint8), np.zeros((1, 2), np.float32)
    kernels.gather_samples(
        point,
        normal,
        np.array([0.05], np.float32),
        np.array([instance], np.uint16),
        K,
        1,
        depth,
        nothing,
        np.full((40, 40), -1, np.int32),
        nothing,
        (np.full((40, 40, 3), 200, np.uint8),),
        colours,
        weights,
    )
    assert bool(weights.any()) == sampled
