from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_proto.base import Pose
from real2sim_proto.operations import Delete, Duplicate, Insert, Rotate, Scale, SetPose, Translate
from real2sim_server.edit import apply_operations
from real2sim_server.edit.tracks import sample
from real2sim_server.scene import UNSEEN, Coverage, GaussianCloud, Ground


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


def flat(places, thin: int, seen: int) -> GaussianCloud:
    """Gaussians at ``places``, flat along the axis ``thin``; images saw the first ``seen``."""
    count = len(places)
    scales = torch.full((count, 3), 0.3)
    scales[:, thin] = 0.01
    uncertainties = torch.full((count,), UNSEEN)
    uncertainties[:seen] = 0.05
    return GaussianCloud(
        means=torch.tensor(places, dtype=torch.float32),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=scales,
        opacities=torch.ones(count),
        sh=torch.zeros(count, 1, 3),
        uncertainties=uncertainties,
    )


def parked_car() -> GaussianCloud:
    """The recorded drive passes its right side, which images saw. They saw 3 of 8 of the left."""
    along = np.linspace(-1.5, 1.5, 8)
    return GaussianCloud.concatenate([
        flat([(x, -1.0, 0.0) for x in along], 1, seen=8),
        flat([(x, 1.0, 0.0) for x in along], 1, seen=3),
        flat([(x, 0.0, 0.8) for x in along], 2, seen=0),
    ])  # fmt: skip


def covered(state, summary, *, ground_seen=8, car=None):
    """The state with what images saw of "parked" and of the ground below it."""
    ground = flat([(20 + x, 5.0, 0.0) for x in np.linspace(-1.5, 1.5, 8)], 2, seen=ground_seen)
    coverage = Coverage(ground, {"parked": car or parked_car()}, summary.ego)
    return replace(state, coverage=coverage)


def test_an_object_that_turns_unseen_sides_to_the_drive_is_reported_with_their_share(
    state, summary
):
    turn = Rotate(object_id="parked", angle=np.pi)
    outcome = apply_operations(covered(state, summary), [turn])

    assert [(w.code, w.object_id) for w in outcome.warnings] == [("unseen_sides", "parked")]
    assert outcome.warnings[0].message.startswith("38 % of the sides of 'parked' that face")


@pytest.mark.parametrize(
    "operation",
    [
        Translate(object_id="parked", x=0.4),
        Rotate(object_id="parked", angle=0.2),
        Rotate(object_id="parked", angle=2 * np.pi),
        Scale(object_id="parked", x=1.1),
        Duplicate(object_id="parked", y=3),
    ],
)
def test_an_object_that_keeps_its_side_to_the_drive_is_not_reported(state, summary, operation):
    assert warnings(covered(state, summary), operation) == []


@pytest.mark.parametrize("operation", [
    Translate(object_id="parked", y=-10), Duplicate(object_id="parked", y=-10),
])  # fmt: skip
def test_an_object_on_the_other_side_of_the_drive_shows_its_other_side(state, summary, operation):
    [(code, _)] = warnings(covered(state, summary), operation)

    assert code == "unseen_sides"


def test_sides_that_images_saw_are_not_reported(state, summary):
    known = replace(parked_car(), uncertainties=torch.full((24,), 0.1))
    turn = Rotate(object_id="parked", angle=np.pi)

    assert warnings(covered(state, summary, car=known), turn) == []


def test_people_and_objects_without_uncertainties_are_not_reported(state, summary):
    turn, unknown = (
        Rotate(object_id="parked", angle=np.pi),
        replace(parked_car(), uncertainties=None),
    )
    assert warnings(covered(state, summary, car=unknown), turn) == []

    person = replace(state.objects["parked"], category="pedestrian")
    walking = replace(covered(state, summary, ground_seen=0).with_object(person))
    walking = replace(walking, recorded=walking.objects)
    assert warnings(walking, turn) == warnings(walking, Delete(object_id="parked")) == []


def test_an_asset_has_no_unseen_sides(state_with_assets, summary):
    there = Insert(asset_id="van", pose=Pose(position=(20, -5, 1)), snap=True)

    assert warnings(covered(state_with_assets, summary), there) == []


@pytest.mark.parametrize(
    "operation", [Delete(object_id="parked"), Translate(object_id="parked", x=10)]
)
def test_ground_that_an_object_leaves_is_reported_with_its_seen_share(state, summary, operation):
    assert warnings(covered(state, summary, ground_seen=5), operation) == []

    outcome = apply_operations(covered(state, summary, ground_seen=1), [operation])
    assert [(w.code, w.object_id) for w in outcome.warnings] == [("unseen_ground", "parked")]
    assert outcome.warnings[0].message.startswith("12 % of the ground that 'parked' leaves")


def test_an_object_that_moves_away_and_turns_gives_one_warning_of_each_kind(state, summary):
    away = [Translate(object_id="parked", x=10), Rotate(object_id="parked", angle=np.pi)]

    given = warnings(covered(state, summary, ground_seen=0), *away)
    assert given == [("unseen_ground", "parked"), ("unseen_sides", "parked")]


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
