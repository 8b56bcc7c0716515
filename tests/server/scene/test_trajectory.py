import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from real2sim_server.geometry import quaternion_yaw, transform_from, yaw_quaternion
from real2sim_server.scene import SceneError, TimeOutOfRangeError, Trajectory
from real2sim_server.scene.trajectory import relative_transform

TIMES = np.array([1_000_000, 2_000_000, 4_000_000])
POSITIONS = np.array([[0.0, 0, 0], [10, 0, 1], [10, 30, 1]])
YAWS = np.array([0.0, 0.0, np.pi / 2])


@pytest.fixture
def bend() -> Trajectory:
    return Trajectory(TIMES, POSITIONS, yaw_quaternion(YAWS))


def test_keyframe_poses_are_returned_exactly(bend):
    for i, t in enumerate(TIMES):
        position, quaternion = bend.pose(int(t))
        np.testing.assert_array_equal(position, POSITIONS[i])
        np.testing.assert_array_equal(quaternion, bend.quaternions[i])


def test_positions_are_interpolated_linearly(bend):
    np.testing.assert_allclose(bend.pose(1_250_000)[0], [2.5, 0, 0.25])
    np.testing.assert_allclose(bend.pose(3_500_000)[0], [10, 22.5, 1])


def test_rotations_are_slerped(bend):
    assert quaternion_yaw(bend.pose(3_500_000)[1]) == pytest.approx(0.75 * np.pi / 2)


def test_transform_holds_the_pose(bend):
    np.testing.assert_array_equal(bend.transform(1_250_000), transform_from(*bend.pose(1_250_000)))


@pytest.mark.parametrize("t_us", [999_999, 4_000_001, -1])
@pytest.mark.parametrize("method", ["pose", "transform", "velocity"])
def test_extrapolation_is_refused_with_the_range(bend, method, t_us):
    with pytest.raises(TimeOutOfRangeError, match=r"t_us=.*\[1000000, 4000000\]"):
        getattr(bend, method)(t_us)


def test_velocity_is_that_of_the_segment(bend):
    np.testing.assert_allclose(bend.velocity(1_000_000), [10, 0, 1])
    np.testing.assert_allclose(bend.velocity(1_999_999), [10, 0, 1])
    np.testing.assert_allclose(bend.velocity(2_000_000), [0, 15, 0])
    np.testing.assert_allclose(bend.velocity(4_000_000), [0, 15, 0])


def test_a_single_pose_stands_still():
    still = Trajectory([5], [[1.0, 2, 3]], [[1.0, 0, 0, 0]])
    assert still.start_us == still.end_us == 5
    np.testing.assert_array_equal(still.velocity(5), [0, 0, 0])
    assert not still.covers(6)


@given(
    arrays(np.float64, (4, 4), elements=st.floats(-1, 1)).filter(
        lambda q: (np.linalg.norm(q, axis=1) > 0.1).all()
    )
)
def test_normalizing_unit_quaternions_again_is_exact(q):
    quats = q / np.linalg.norm(q, axis=1, keepdims=True)
    once = Trajectory(np.arange(4), np.zeros((4, 3)), quats)
    twice = Trajectory(once.times_us, once.positions, once.quaternions)
    np.testing.assert_array_equal(once.quaternions, twice.quaternions)


def test_transforms_round_trip(bend):
    transforms = np.stack([bend.transform(int(t)) for t in TIMES])
    again = Trajectory.from_transforms(TIMES, transforms)
    np.testing.assert_allclose(again.positions, bend.positions)
    np.testing.assert_allclose(again.quaternions, bend.quaternions, atol=1e-15)


def test_moving_the_fixed_frame_moves_every_pose(bend):
    shift = transform_from([5.0, 6, 7], yaw_quaternion(0.3))
    moved = bend.moved(shift)
    for t in (1_000_000, 3_300_000):
        np.testing.assert_allclose(moved.transform(t), shift @ bend.transform(t), atol=1e-12)


def test_relative_transform_maps_one_pose_to_the_other(bend):
    a, b = bend.transform(1_500_000), bend.transform(3_000_000)
    np.testing.assert_allclose(a @ relative_transform(a, b), b, atol=1e-12)


def test_input_arrays_are_copied():
    positions = np.zeros((1, 3))
    trajectory = Trajectory([0], positions, [[1.0, 0, 0, 0]])
    positions[0, 0] = 99
    assert trajectory.positions[0, 0] == 0


UNIT = [[1.0, 0, 0, 0]] * 2
ZERO = np.zeros((2, 3))


@pytest.mark.parametrize(
    ("times", "positions", "quaternions", "reason"),
    [
        ([0, 0], ZERO, UNIT, "increase strictly"),
        ([1, 0], ZERO, UNIT, "increase strictly"),
        ([0, 1, 2], ZERO, UNIT, "needs positions"),
        ([0, 1], [[0, 0, np.nan], [0, 0, 0]], UNIT, "not finite"),
        ([0, 1], ZERO, [[np.inf, 0, 0, 0], [1, 0, 0, 0]], "not finite"),
        ([0, 1], ZERO, [[2.0, 0, 0, 0], [1, 0, 0, 0]], "unit length"),
        ([0, 1], ZERO, np.zeros((2, 4)), "unit length"),
        ([0.5, 1.0], ZERO, UNIT, "whole microseconds"),
        ([0, np.nan], ZERO, UNIT, "whole microseconds"),
        ([], np.zeros((0, 3)), np.zeros((0, 4)), "at least one pose"),
    ],
)
def test_bad_input_is_refused(times, positions, quaternions, reason):
    with pytest.raises(SceneError, match=reason):
        Trajectory(times, positions, quaternions)


@pytest.mark.parametrize("bad", [np.eye(4) * 2, np.diag([1.0, 1, -1, 1]), np.full((4, 4), np.nan)])
def test_invalid_rotations_are_refused_with_their_index(bad):
    with pytest.raises(SceneError, match="index 1"):
        Trajectory.from_transforms([0, 1], np.stack([np.eye(4), bad]))


@pytest.mark.parametrize(
    ("x", "leads"), [([0, 1, 2.1], True), ([0, 0.1, 0], False), ([0, 1.9, 0], True)]
)
def test_a_trajectory_moves_when_it_ends_elsewhere_or_spreads(x, leads):
    positions = np.stack([x, np.zeros(3), np.zeros(3)], axis=1)
    trajectory = Trajectory([0, 1, 2], positions, np.tile([1.0, 0, 0, 0], (3, 1)))
    assert trajectory.moves is leads
