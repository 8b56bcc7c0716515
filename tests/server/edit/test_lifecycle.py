from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose, Track
from real2sim_proto.operations import Delete, Duplicate, EraseRegion, Insert, Replace, Restore
from real2sim_server.edit import EditError, apply_operations

HERE = Pose(position=(8, 3, 0))


@pytest.fixture
def state(state_with_assets):
    return state_with_assets


def test_an_inserted_asset_stands_on_the_ground_with_a_new_instance(state):
    outcome = apply_operations(state, [Insert(asset_id="van", pose=HERE)])
    van = outcome.state.objects["van_1"]

    assert outcome.created == ("van_1",)
    assert (van.category, van.scaled_size, van.instance_id) == ("truck", (5.0, 2.1, 2.0), 5)
    np.testing.assert_allclose(van.trajectory.positions, [[8, 3, 1.0]] * 2, atol=0.01)
    assert (van.trajectory.start_us, van.trajectory.end_us) == state.time_range


def test_an_inserted_asset_can_be_fitted_to_a_size_and_follow_a_trajectory(state):
    way = Track(times_us=[5, 9], positions=[(0, 0, 0), (4, 0, 0)], quaternions=[(1, 0, 0, 0)] * 2)
    insert = Insert(asset_id="van", object_id="toy", trajectory=way, size=(2.5, 1, 1), snap=False)
    toy = apply_operations(state, [insert]).state.objects["toy"]

    assert toy.scaled_size == pytest.approx((2.5, 1, 1))
    np.testing.assert_array_equal(toy.trajectory.positions, [[0, 0, 0], [4, 0, 0]])


def test_an_unknown_asset_is_refused(state):
    with pytest.raises(EditError, match="no asset 'bus'") as refused:
        apply_operations(state, [Insert(asset_id="bus", pose=HERE)])

    assert refused.value.code == ErrorCode.UNKNOWN_ASSET


@pytest.mark.parametrize("where", [{}, {"pose": HERE, "trajectory": "both"}])
def test_an_insert_needs_exactly_one_position(where):
    track = Track(times_us=[0], positions=[(0, 0, 0)], quaternions=[(1, 0, 0, 0)])
    given = {k: track if v == "both" else v for k, v in where.items()}
    with pytest.raises(ValueError, match="either a pose or a trajectory"):
        Insert(asset_id="van", **given)


def test_a_replacement_fills_the_box_and_keeps_motion_and_instance(state):
    after = apply_operations(state, [Replace(object_id="crossing", asset_id="van")]).state
    old, new = state.objects["crossing"], after.objects["crossing"]

    assert new.scaled_size == pytest.approx(old.scaled_size)
    assert (new.asset.asset_id, new.instance_id) == ("van", old.instance_id)
    np.testing.assert_allclose(new.trajectory.positions, old.trajectory.positions, atol=1e-12)


def test_a_replacement_by_length_keeps_proportions_and_the_bottom(state):
    replace = Replace(object_id="parked", asset_id="van", fit="length")
    new = apply_operations(state, [replace]).state.objects["parked"]

    assert new.scaled_size == pytest.approx((4.0, 1.68, 1.6))
    assert new.trajectory.positions[0, 2] == pytest.approx(0.8)


def test_the_inverse_of_a_replacement_restores_the_recorded_look(state):
    outcome = apply_operations(state, [Replace(object_id="parked", asset_id="van", fit="length")])
    back = apply_operations(outcome.state, outcome.inverse).state.objects["parked"]

    assert (back.source_id, back.asset, back.category) == ("parked", None, "car")
    assert back.scale == pytest.approx((1, 1, 1))


def test_regions_and_objects_share_ids(state):
    region = EraseRegion(region_id="parked", pose=HERE, size=(1, 1, 1))

    with pytest.raises(EditError, match="'parked' is taken"):
        apply_operations(state, [region])


def test_an_erased_region_is_added_and_removed_by_id(state):
    region = EraseRegion(pose=HERE, size=(1, 1, 1))
    erased = apply_operations(state, [region])
    gone = apply_operations(erased.state, [Delete(object_id="region_1")]).state
    back = apply_operations(gone, [Restore(object_id="region_1")]).state

    assert erased.created == ("region_1",)
    assert (len(gone.erased), len(back.erased)) == (0, 1)
    with pytest.raises(EditError, match="deleted already"):
        apply_operations(gone, [Delete(object_id="region_1")])


def test_new_ids_skip_regions_and_colliders(state):
    region = EraseRegion(region_id="parked_copy1", pose=HERE, size=(1, 1, 1))
    outcome = apply_operations(state, [region, Duplicate(object_id="parked")])

    assert outcome.created == ("parked_copy1", "parked_copy2")
