from __future__ import annotations

import numpy as np

from real2sim_server.reconstruct.initialise.accumulate import (
    HEIGHT,
    ScanLimit,
    continue_walls,
    real_walls,
)
from real2sim_server.reconstruct.initialise.surfels import fit_surfels

LIMIT = ScanLimit(path=np.zeros((1, 3)), height=1.8, slope=0.05)


def wall(top: float, *, x: float = 10.0):
    y, z = np.meshgrid(np.arange(-4, 4, 0.1), np.arange(0.2, top, 0.1))
    points = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)
    return fit_surfels(points.astype(np.float32), largest=0.1)


def test_a_wall_at_the_scan_limit_continues_above_it():
    walls = continue_walls(wall(2.6), LIMIT, max_count=100_000)
    np.testing.assert_allclose(walls.points[:, 0], 10, atol=0.02)
    assert np.abs(walls.points[:, 1]).max() < 4.1
    assert walls.points[:, 2].min() > 1.8 + 0.05 * 10 - 0.1
    assert walls.points[:, 2].max() > HEIGHT
    assert np.abs(walls.normals[:, 0]).min() > 0.95


def test_a_hedge_below_the_scan_limit_is_not_continued():
    assert len(continue_walls(wall(1.4), LIMIT, max_count=100_000)) == 0


def test_a_distant_wall_is_not_continued():
    assert len(continue_walls(wall(8.0, x=60.0), LIMIT, max_count=100_000)) == 0


def test_the_number_of_wall_points_is_limited():
    assert 0 < len(continue_walls(wall(2.6), LIMIT, max_count=300)) <= 300


def test_no_surfels_give_no_walls():
    empty = fit_surfels(np.zeros((0, 3), np.float32), largest=0.1)
    assert len(continue_walls(empty, LIMIT, max_count=100)) == 0


def test_sky_unseen_and_inconsistent_candidates_are_rejected():
    brick, blue, white = (0.5, 0.35, 0.3), (0.45, 0.6, 0.8), (1.0, 1.0, 1.0)
    colours = np.array([brick, brick, brick, blue, white], np.float32)
    known = np.array([True, False, True, True, True])
    deviation = np.array([5, 5, 80, 2, 1], np.float32)
    assert real_walls(colours, known, deviation).tolist() == [True, False, False, False, False]
