from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose, Track
from real2sim_proto.operations import (
    Delete,
    Duplicate,
    Operation,
    Restore,
    Rotate,
    Scale,
    SetPose,
    SetTrajectory,
    TimeRange,
    Translate,
)
from real2sim_server.edit import EditError, ObjectState, ScenarioState, apply_operations
from real2sim_server.edit.apply import replay_operations
from real2sim_server.geometry import box_corners, quaternion_yaw


def after(state: ScenarioState, *operations: Operation, of: str = "turning") -> ObjectState:
    return apply_operations(state, operations).state.objects[of]


def transforms(subject: ObjectState) -> np.ndarray:
    return np.stack([subject.trajectory.transform(int(t)) for t in subject.trajectory.times_us])


def test_translate_in_the_world_shifts_every_position(state):
    moved = after(state, Translate(object_id="turning", x=1, y=-2, z=3))

    before = state.objects["turning"].trajectory
    np.testing.assert_allclose(moved.trajectory.positions - before.positions, [[1, -2, 3]] * 50)
    np.testing.assert_array_equal(moved.trajectory.quaternions, before.quaternions)


def test_translate_in_the_object_frame_turns_with_the_object(state):
    moved = after(state, Translate(object_id="turning", y=2, frame="object"))

    # A circle of radius 15 m about (40, 25): two metres to the left is two metres inwards.
    radii = np.linalg.norm(moved.trajectory.positions[:, :2] - [40, 25], axis=1)
    np.testing.assert_allclose(radii, 13)


@pytest.mark.parametrize("frame", ["world", "object"])
def test_rotate_turns_about_the_objects_own_centre(state, frame):
    turned = after(state, Rotate(object_id="turning", angle=np.pi / 2, frame=frame))

    old, new = transforms(state.objects["turning"]), transforms(turned)
    np.testing.assert_allclose(new[:, :3, 3], old[:, :3, 3])
    np.testing.assert_allclose(new[:, :3, 0], old[:, :3, 1], atol=1e-12)


ANGLE = 0.7


def slips(trajectory) -> np.ndarray:
    """Angles between direction of travel and heading [rad], for motion in a plane."""
    way = np.diff(trajectory.positions[:, :2], axis=0)
    headings = quaternion_yaw(trajectory.quaternions)
    off = np.arctan2(way[:, 1], way[:, 0]) - (headings[1:] + headings[:-1]) / 2
    return np.abs((off + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("frame", ["world", "object"])
@pytest.mark.parametrize("name", ["crossing", "turning"])
def test_a_rotation_about_an_instant_turns_the_path(state, name, frame):
    before = state.objects[name].trajectory
    rotation = Rotate(object_id=name, angle=ANGLE, frame=frame, about_us=500_000)
    turned = apply_operations(state, [rotation])
    now = turned.state.objects[name].trajectory
    assert slips(now).max() < 1e-6
    np.testing.assert_allclose(now.pose(500_000)[0], before.pose(500_000)[0], atol=1e-9)
    ways = [t.positions[-1] - t.positions[0] for t in (before, now)]
    headings = [np.arctan2(way[1], way[0]) for way in ways]
    assert headings[1] - headings[0] == pytest.approx(ANGLE)
    assert "sideways" not in {w.code for w in turned.warnings}
    back = apply_operations(turned.state, turned.inverse).state.objects[name].trajectory
    np.testing.assert_allclose(back.positions, before.positions, atol=1e-9)


def test_a_rotation_from_an_instant_turns_the_rest_of_the_path(state):
    before = state.objects["crossing"].trajectory
    when = TimeRange(start_us=800_000, blend_us=400_000)
    turned = apply_operations(
        state, [Rotate(object_id="crossing", angle=ANGLE, about_us=1_000_000, time_range=when)]
    )
    now = turned.state.objects["crossing"].trajectory
    for t_us in (0, 400_000, 800_000):
        np.testing.assert_allclose(now.pose(t_us)[0], before.pose(t_us)[0], atol=1e-9)
    way = now.pose(now.end_us)[0] - now.pose(1_300_000)[0]
    assert np.arctan2(way[1], way[0]) == pytest.approx(0.3 + ANGLE)
    assert "sideways" not in {w.code for w in turned.warnings}


def test_sideways_motion_gives_a_warning(state):
    for name, warned in (("crossing", True), ("turning", True), ("parked", False)):
        rotation = Rotate(object_id=name, angle=np.radians(42))
        found = {w.code: w.message for w in apply_operations(state, [rotation]).warnings}
        assert ("sideways" in found) == warned
        if warned:
            assert f"{name!r} goes sideways, up to 42 degrees" in found["sideways"]


def test_rotating_about_a_world_axis_differs_from_the_objects_own(state):
    operation = Rotate(object_id="crossing", angle=np.pi / 2, axis=(2, 0, 0))
    world = transforms(after(state, operation, of="crossing"))[0]
    own_axis = operation.model_copy(update={"frame": "object"})
    own = transforms(after(state, own_axis, of="crossing"))[0]

    c, s = np.cos(0.3), np.sin(0.3)
    np.testing.assert_allclose(world[:3, 0], [c, 0, s], atol=1e-12)
    np.testing.assert_allclose(own[:3, 0], [c, s, 0], atol=1e-12)


@pytest.mark.parametrize(("anchor", "rows"), [("bottom", slice(0, 4)), ("centre", None)])
def test_scale_keeps_its_anchor(state, anchor, rows):
    tilted = [Rotate(object_id="turning", angle=0.2, axis=(1, 0, 0), frame="object")]
    before = after(state, *tilted)
    scaled = after(state, *tilted, Scale(object_id="turning", z=3, anchor=anchor))

    old = box_corners(transforms(before), before.scaled_size)
    new = box_corners(transforms(scaled), scaled.scaled_size)
    kept = slice(None) if rows is None else rows
    np.testing.assert_allclose(new[:, kept].mean(axis=1), old[:, kept].mean(axis=1), atol=1e-12)
    assert scaled.scaled_size == pytest.approx((4.0, 2.0, 4.8))
    assert scaled.size == (4.0, 2.0, 1.6)


def test_scales_multiply(state):
    twice = [Scale(object_id="parked", x=2, y=3)] * 2

    assert after(state, *twice, of="parked").scale == (4, 9, 1)


def test_excessive_scales_are_refused(state):
    with pytest.raises(EditError, match=r"0\.001 to 1000 is allowed") as refused:
        apply_operations(state, [Scale(object_id="parked", x=100)] * 2)

    assert refused.value.code == ErrorCode.INVALID_OPERATION
    assert refused.value.index == 1


def test_set_pose_applies_to_the_whole_time_range(state):
    pose = Pose(position=(1, 2, 3), quaternion=(0, 0, 0, 1))
    stood = after(state, SetPose(object_id="late", pose=pose), of="late").trajectory

    assert (stood.start_us, stood.end_us) == state.time_range
    np.testing.assert_array_equal(stood.positions, [[1, 2, 3]] * 2)
    np.testing.assert_array_equal(stood.velocity(stood.start_us), [0, 0, 0])


def test_set_trajectory_replaces_the_motion(state):
    track = Track(
        times_us=[0, 1_000_000],
        positions=[(0, 0, 1), (10, 0, 1)],
        quaternions=[(1, 0, 0, 0)] * 2,
    )
    moved = after(state, SetTrajectory(object_id="late", trajectory=track), of="late").trajectory

    np.testing.assert_allclose(moved.pose(500_000)[0], [5, 0, 1])
    assert not moved.covers(1_000_001)


def test_an_invalid_trajectory_is_refused_with_its_location(state):
    track = Track.model_construct(
        times_us=[0, 0], positions=[(0, 0, 0)] * 2, quaternions=[(1, 0, 0, 0)] * 2
    )
    with pytest.raises(EditError, match=r"operation 0 .*increase strictly"):
        apply_operations(state, [SetTrajectory.model_construct(object_id="late", trajectory=track)])


def test_duplicate_is_a_shifted_copy_with_its_own_instance(state):
    outcome = apply_operations(state, [Duplicate(object_id="late", x=5)])
    copy, original = outcome.state.objects["late_copy1"], state.objects["late"]

    assert outcome.created == ("late_copy1",)
    assert copy.source_id == "late"
    assert copy.instance_id == 5
    difference = copy.trajectory.positions - original.trajectory.positions
    np.testing.assert_allclose(difference, [[5, 0, 0]] * 20)


def test_copies_of_copies_show_the_same_source(state):
    copies = [Duplicate(object_id="late"), Duplicate(object_id="late_copy1", new_id="third")]

    assert after(state, *copies, of="third").source_id == "late"


def test_default_copy_ids_skip_taken_ones_even_if_deleted(state):
    outcome = apply_operations(
        state,
        [
            Duplicate(object_id="late", new_id="late_copy2"),
            Duplicate(object_id="late"),
            Delete(object_id="late_copy1"),
            Duplicate(object_id="late"),
        ],
    )

    assert outcome.created == ("late_copy2", "late_copy1", "late_copy3")


@pytest.mark.parametrize("taken", ["parked", "late"])
def test_duplicate_onto_a_taken_id_is_refused(state, taken):
    with pytest.raises(EditError, match=f"'{taken}' is taken") as refused:
        apply_operations(state, [Duplicate(object_id="late", new_id=taken)])

    assert refused.value.code == ErrorCode.INVALID_OPERATION


def test_duplicate_whose_default_id_gets_too_long_is_refused(state):
    long_id = "a" * 80
    renamed = [Duplicate(object_id="late", new_id=long_id), Duplicate(object_id=long_id)]

    with pytest.raises(EditError, match="longer than 80") as refused:
        apply_operations(state, renamed)

    assert "new_id" in refused.value.hint


def test_a_deleted_object_is_a_tombstone(state):
    gone = apply_operations(state, [Delete(object_id="parked")]).state

    assert gone.objects["parked"].deleted
    assert "parked" not in [o.object_id for o in gone.visible]


def test_restore_brings_a_deleted_object_back_unchanged(state):
    moved = apply_operations(state, [Translate(object_id="parked", x=1)]).state
    gone = apply_operations(moved, [Delete(object_id="parked")]).state
    back = apply_operations(gone, [Restore(object_id="parked")]).state.objects["parked"]

    assert back.trajectory is moved.objects["parked"].trajectory
    assert not back.deleted


@pytest.mark.parametrize(
    "operation",
    [Translate(object_id="parked"), Delete(object_id="parked"), Duplicate(object_id="parked")],
)
def test_editing_a_deleted_object_is_refused_with_a_remedy(state, operation):
    gone = apply_operations(state, [Delete(object_id="parked")]).state

    with pytest.raises(EditError, match="'parked' is deleted") as refused:
        apply_operations(gone, [operation])

    assert refused.value.code == ErrorCode.INVALID_OPERATION
    assert "restore" in refused.value.hint


def test_restoring_an_existing_object_is_refused(state):
    with pytest.raises(EditError, match="not deleted"):
        apply_operations(state, [Restore(object_id="parked")])


def test_unknown_ids_are_refused_with_the_known_ones(state):
    with pytest.raises(EditError, match=r"operation 1 .*no object 'parkd'") as refused:
        apply_operations(state, [Delete(object_id="late"), Delete(object_id="parkd")])

    assert refused.value.code == ErrorCode.UNKNOWN_OBJECT
    assert refused.value.hint == "objects of this scenario: parked, crossing, turning"


def test_objects_cannot_leave_the_range_of_the_protocol(state):
    with pytest.raises(EditError, match="1e\\+06 m is allowed"):
        apply_operations(state, [Translate(object_id="parked", x=1e6)])


def test_a_scene_and_its_summary_give_the_same_state(summary, state):
    by_id = {o.object_id: o for o in summary.objects}
    as_mapping = type(summary)(**vars(summary) | {"objects": by_id})

    assert list(ScenarioState.of(as_mapping).objects) == list(state.objects)
    assert [o.instance_id for o in state.objects.values()] == [1, 2, 3, 4]


def test_the_object_limit_does_not_count_deleted_objects(state, monkeypatch):
    present = sum(not found.deleted for found in state.objects.values())
    monkeypatch.setattr("real2sim_server.edit.apply.MAX_OBJECTS", present + 1)
    full = apply_operations(state, [Duplicate(object_id="parked", x=9)]).state

    with pytest.raises(EditError, match=f"{present + 1} objects at most") as refused:
        apply_operations(full, [Duplicate(object_id="parked", x=18)])
    assert (refused.value.code, refused.value.index) == ("INVALID_OPERATION", 0)

    room = [Delete(object_id="turning"), Duplicate(object_id="parked", x=18)]
    assert len(apply_operations(full, room).created) == 1


def test_a_log_from_before_the_limit_is_fully_replayed(state, monkeypatch):
    monkeypatch.setattr("real2sim_server.edit.apply.MAX_OBJECTS", 1)
    after = replay_operations(state, [Duplicate(object_id="parked", x=9)])
    assert "parked_copy1" in after.objects
