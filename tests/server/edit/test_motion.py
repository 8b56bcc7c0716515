from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose
from real2sim_proto.operations import (
    Duplicate,
    Retime,
    Rotate,
    SetPose,
    TimeRange,
    Translate,
)
from real2sim_server.edit import EditError, apply_operations
from real2sim_server.edit.tracks import sample
from real2sim_server.geometry import box_corners, quaternion_yaw

SECOND = 1_000_000


def trajectory(state, operation, of="crossing"):
    return apply_operations(state, [operation]).state.objects[of].trajectory


def at(track, *seconds):
    return np.stack([track.pose(round(s * SECOND))[0] for s in seconds])


def lane_change(**time_range):
    span = TimeRange(**time_range)
    return Translate(object_id="crossing", y=3.5, time_range=span)


def test_a_shift_from_a_time_changes_only_what_comes_after(state):
    moved = trajectory(state, lane_change(start_us=SECOND, blend_us=2 * SECOND))
    before = state.objects["crossing"].trajectory

    offsets = at(moved, 0, 0.5, 1, 2, 3, 4) - at(before, 0, 0.5, 1, 2, 3, 4)
    np.testing.assert_allclose(offsets[:, 1], [0, 0, 0, 1.75, 3.5, 3.5], atol=1e-9)
    np.testing.assert_allclose(offsets[:, [0, 2]], 0, atol=1e-9)


def test_a_shift_up_to_a_time_fades_out_before_it(state):
    moved = trajectory(state, lane_change(end_us=3 * SECOND, blend_us=SECOND))

    offsets = at(moved, 0, 2, 2.5, 3, 4) - at(state.objects["crossing"].trajectory, 0, 2, 2.5, 3, 4)
    np.testing.assert_allclose(offsets[:, 1], [3.5, 3.5, 1.75, 0, 0], atol=1e-9)


def test_a_blend_joins_the_recording_smoothly(state):
    moved = trajectory(state, lane_change(start_us=SECOND, blend_us=2 * SECOND))
    before = state.objects["crossing"].trajectory

    times = np.arange(SECOND, 3 * SECOND + 1, 50_000)
    offset = (sample(moved, times)[0] - sample(before, times)[0])[:, 1, 3]
    speed = np.diff(offset) / 0.05
    # A minimum-jerk motion of D metres in T seconds peaks at 1.875 D / T.
    assert speed.max() == pytest.approx(1.875 * 3.5 / 2, rel=0.01)
    assert speed[[0, -1]].max() < 0.02 * speed.max()
    assert (speed >= 0).all()


def test_without_a_blend_the_edit_jumps_within_a_microsecond(state):
    moved = trajectory(state, lane_change(start_us=1_050_000, blend_us=0))
    before = state.objects["crossing"].trajectory

    offsets = [moved.pose(t)[0][1] - before.pose(t)[0][1] for t in (1_049_999, 1_050_000)]
    np.testing.assert_allclose(offsets, [0, 3.5], atol=1e-9)


def test_a_rotation_in_a_time_range_keeps_positions_and_fades_in(state):
    span = TimeRange(start_us=2 * SECOND, blend_us=SECOND)
    turned = trajectory(
        state, Rotate(object_id="parked", angle=np.pi / 2, time_range=span), of="parked"
    )

    yaws = [float(quaternion_yaw(turned.pose(round(t * SECOND))[1])) for t in (1, 2, 2.5, 3, 4)]
    np.testing.assert_allclose(yaws, [0, 0, np.pi / 4, np.pi / 2, np.pi / 2], atol=1e-6)
    np.testing.assert_array_equal(at(turned, 1, 3), [[20, 5, 0.8]] * 2)


def test_a_time_range_that_ends_before_it_starts_is_refused():
    with pytest.raises(ValueError, match="not before end_us"):
        TimeRange(start_us=2, end_us=1)


def test_retiming_follows_the_same_path_later_and_faster(state):
    retimed = trajectory(state, Retime(object_id="late", delay_us=SECOND, speed=2), of="late")
    before = state.objects["late"].trajectory

    assert retimed.start_us == before.start_us + SECOND
    assert retimed.end_us - retimed.start_us == (before.end_us - before.start_us) // 2
    np.testing.assert_array_equal(retimed.positions, before.positions)


def test_retiming_to_the_same_microsecond_is_refused(state):
    close = [Retime(object_id="late", speed=100)] * 3

    with pytest.raises(EditError, match="same microsecond") as refused:
        apply_operations(state, close)

    assert refused.value.code == ErrorCode.INVALID_OPERATION


@pytest.mark.parametrize(
    "operation",
    [
        SetPose(object_id="parked", pose=Pose(position=(8, 2, 7)), snap=True),
        Translate(object_id="parked", x=-12, y=-3, z=1.0, snap=True),
    ],
)
def test_a_snapped_object_stands_on_the_ground(state, operation):
    standing = apply_operations(state, [operation]).state.objects["parked"]

    bottoms = box_corners(standing.trajectory.transform(0), standing.scaled_size)[:4, 2]
    np.testing.assert_allclose(bottoms, 0, atol=0.01)


def test_a_snapped_copy_stands_beside_a_floating_original(state):
    floating = Translate(object_id="parked", z=4)
    copy = Duplicate(object_id="parked", new_id="twin", y=5, snap=True)
    after = apply_operations(state, [floating, copy]).state.objects

    assert after["parked"].trajectory.positions[0, 2] == pytest.approx(4.8)
    assert after["twin"].trajectory.positions[0, 2] == pytest.approx(0.8, abs=0.01)
