from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from real2sim_server.reconstruct.initialise.accumulate import PointSet, thin, thin_to, voxel_levels


def cloud_of(seed: int, count: int) -> PointSet:
    rng = np.random.default_rng(seed)
    return PointSet.measured(rng.uniform(-5, 5, (count, 3)), rng.uniform(0, 1, count))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), count=st.integers(1, 400), voxel=st.floats(0.05, 3))
def test_thinning_leaves_at_most_one_point_in_a_voxel(seed, count, voxel):
    thinned = thin(cloud_of(seed, count), voxel)
    # Rounding can move a mean onto the border of its voxel, hence the tolerance.
    cells = np.floor(thinned.points.astype(np.float64) / voxel + 1e-4)
    others = np.floor(thinned.points.astype(np.float64) / voxel - 1e-4)
    inside = (cells == others).all(axis=1)
    assert len(np.unique(cells[inside], axis=0)) == inside.sum()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), count=st.integers(1, 400), voxel=st.floats(0.05, 3))
def test_thinning_keeps_total_weight_and_centre_of_mass(seed, count, voxel):
    cloud = cloud_of(seed, count)
    thinned = thin(cloud, voxel)
    assert thinned.weight.sum() == count
    centre = (thinned.points * thinned.weight[:, None]).sum(0) / count
    np.testing.assert_allclose(centre, cloud.points.mean(0), atol=1e-4)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 999), voxel=st.floats(0.05, 2))
def test_thinning_moves_no_point_farther_than_its_voxel(seed, voxel):
    from scipy.spatial import cKDTree

    cloud = cloud_of(seed, 300)
    distance, _ = cKDTree(thin(cloud, voxel).points).query(cloud.points)
    assert distance.max() <= voxel * 3**0.5 + 1e-4


def test_thinning_depends_on_point_order_only_by_rounding():
    cloud = cloud_of(3, 500)
    shuffled = cloud.select(np.random.default_rng(0).permutation(500))
    np.testing.assert_allclose(thin(cloud, 0.5).points, thin(shuffled, 0.5).points, atol=1e-5)


def test_points_of_different_levels_are_never_merged():
    cloud = PointSet.measured(np.zeros((2, 3)), np.zeros(2))
    assert len(thin(cloud, 1.0, np.array([0, 1]))) == 2


def test_thinning_respects_the_limit():
    assert 0 < len(thin_to(cloud_of(0, 5000), 0.01, 200)) <= 200


def test_thinning_an_empty_set_gives_an_empty_set():
    assert len(thin(PointSet.join([]), 0.1)) == 0


def test_levels_grow_with_distance_and_start_at_zero():
    levels = voxel_levels(np.array([0, 10, 30, 100, 1e6], np.float32), 0.05, 0.005)
    assert levels[0] == 0
    assert (np.diff(levels) >= 0).all()
    assert levels[3] == 3
