from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_proto.base import Pose
from real2sim_proto.operations import Delete, Duplicate, Insert, Rotate, Scale, SetPose, Translate
from real2sim_server.edit import apply_operations
from real2sim_server.edit.tracks import sample
from real2sim_server.scene import Ground


def warnings(state, *operations):
    outcome = apply_operations(state, operations)
    return [(w.code, w.object_id) for w in outcome.warnings]


def test_a_harmless_shift_gives_no_warning(state):
    assert warnings(state, Translate(object_id="parked", x=1)) == []


def test_a_copy_in_its_original_overlaps(state):
    assert warnings(state, Duplicate(object_id="parked", x=1)) == [("overlap", "parked_copy1")]


def test_a_copy_beside_its_original_does_not_overlap(state):
    assert warnings(state, Duplicate(object_id="parked", y=2.01)) == []


def test_a_copy_in_a_deleted_original_does_not_overlap(state):
    operations = [Duplicate(object_id="parked"), Delete(object_id="parked")]

    assert warnings(state, *operations) == []


def test_paths_that_cross_at_different_times_do_not_overlap(state):
    # "crossing" passes (7.6, -27.6) after one second and is 24 m farther on at t = 4 s.
    there = SetPose(object_id="parked", pose=Pose(position=(7.6, -27.6, 0.8)))
    assert warnings(state, there) == [("overlap", "parked")]

    late = Translate(object_id="late", x=7.6 - 60, y=-27.6 + 8)
    assert warnings(state, late) == []


def test_an_overlap_names_the_other_and_the_time(state):
    outcome = apply_operations(state, [Translate(object_id="parked", x=20, y=6)])

    assert [w.message for w in outcome.warnings] == ["'parked' overlaps 'turning' from t=0.00 s"]


@pytest.mark.parametrize(("lift", "side"), [(0.4, "above"), (-0.4, "below")])
def test_an_object_off_the_ground_is_reported_with_its_height(state, lift, side):
    outcome = apply_operations(state, [Translate(object_id="parked", z=lift)])

    assert [w.code for w in outcome.warnings] == ["off_ground"]
    assert f"0.40 m {side}" in outcome.warnings[0].message


@pytest.mark.parametrize(
    "operation",
    [
        Translate(object_id="parked", z=0.25),
        Scale(object_id="parked", z=3),
        Rotate(object_id="parked", angle=1),
    ],
)
def test_an_object_on_the_ground_is_not_reported(state, operation):
    assert warnings(state, operation) == []


def test_a_tilted_object_digs_into_the_ground(state):
    tilt = Rotate(object_id="parked", angle=0.5, axis=(0, 1, 0))

    assert warnings(state, tilt) == [("off_ground", "parked")]


def test_the_known_ground_height_is_used(state):
    rise = np.repeat(0.1 * np.arange(80.0)[:, None], 80, axis=1)
    slope = Ground(np.array([-0.5, -40.5]), 1.0, rise, np.ones((80, 80), dtype=bool))
    up_the_hill = Translate(object_id="parked", x=10, z=1)

    assert warnings(replace(state, ground=slope), up_the_hill) == []
    assert warnings(state, up_the_hill) == [("off_ground", "parked")]


def test_a_floating_asset_is_reported_against_the_ground(state_with_assets):
    floating = Insert(asset_id="van", pose=Pose(position=(8, 3, 3)), snap=False)
    outcome = apply_operations(state_with_assets, [floating])

    assert [w.code for w in outcome.warnings] == ["off_ground"]
    assert outcome.warnings[0].message.endswith("2.00 m above the ground")


@pytest.mark.parametrize(("y", "expected"), [(90, []), (150, [("outside_map", "parked")])])
def test_objects_far_from_everything_recorded_are_reported(state, y, expected):
    assert warnings(state, Translate(object_id="parked", y=y)) == expected


@pytest.mark.slow
def test_edits_of_a_large_scenario_do_not_resample_trajectories(state, monkeypatch):
    """With 600 overlapping copies, the cost of a batch grows steadily, without a jump."""
    copies = [Duplicate(object_id="parked", new_id=f"copy_{k}", x=0.01) for k in range(600)]
    crowded = apply_operations(state, copies).state
    sampled = []

    def counted(trajectory, times):
        sampled.append(trajectory)
        return sample(trajectory, times)

    monkeypatch.setattr("real2sim_server.edit.apply.sample", counted)
    apply_operations(crowded, [Duplicate(object_id="parked", new_id="one_more", x=0.02)])

    assert len(sampled) <= 1
