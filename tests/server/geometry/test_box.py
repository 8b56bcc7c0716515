import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import linprog

from real2sim_server.geometry import (
    box_corners,
    box_penetration,
    boxes_overlap,
    transform_from,
    yaw_quaternion,
)

sizes = arrays(np.float64, 3, elements=st.floats(0.1, 5))
poses = st.builds(
    transform_from,
    arrays(np.float64, 3, elements=st.floats(-4, 4)),
    arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1),
)

CUBE = np.full(3, 2.0)


def overlap_by_linear_program(pose_a, size_a, pose_b, size_b) -> bool:
    """Whether a point lies in both boxes: feasibility of twelve half-spaces."""
    rows, bounds = [], []
    for pose, size in ((pose_a, size_a), (pose_b, size_b)):
        axes = pose[:3, :3].T
        along = axes @ pose[:3, 3]
        rows += [axes, -axes]
        bounds += [along + size / 2, size / 2 - along]
    answer = linprog(
        np.zeros(3), np.vstack(rows), np.concatenate(bounds), bounds=[(None, None)] * 3
    )
    return answer.status == 0


def test_corners_of_a_turned_box():
    corners = box_corners(transform_from([10.0, 0, 1], yaw_quaternion(np.pi / 2)), (4, 2, 2))
    np.testing.assert_allclose(corners.min(axis=0), [9, -2, 0], atol=1e-12)
    np.testing.assert_allclose(corners.max(axis=0), [11, 2, 2], atol=1e-12)
    np.testing.assert_allclose(corners[0], [11, -2, 0], atol=1e-12)
    np.testing.assert_allclose(corners[1] - corners[0], [0, 4, 0], atol=1e-12)


@given(poses, sizes, poses, sizes)
def test_overlap_agrees_with_a_linear_program(pose_a, size_a, pose_b, size_b):
    assume(abs(box_penetration(pose_a, size_a, pose_b, size_b)) > 1e-6)
    expected = overlap_by_linear_program(pose_a, size_a, pose_b, size_b)
    assert boxes_overlap(pose_a, size_a, pose_b, size_b) == expected


@given(poses, sizes, poses, sizes)
def test_overlap_is_symmetric(pose_a, size_a, pose_b, size_b):
    there = box_penetration(pose_a, size_a, pose_b, size_b)
    assert there == pytest.approx(box_penetration(pose_b, size_b, pose_a, size_a), abs=1e-9)


@given(poses, sizes, poses, sizes, poses)
def test_overlap_does_not_depend_on_the_frame(pose_a, size_a, pose_b, size_b, frame):
    here = box_penetration(pose_a, size_a, pose_b, size_b)
    there = box_penetration(frame @ pose_a, size_a, frame @ pose_b, size_b)
    assert here == pytest.approx(there, abs=1e-9)


@given(poses, sizes)
def test_a_box_overlaps_itself(pose, size):
    assert boxes_overlap(pose, size, pose, size)
    assert box_penetration(pose, size, pose, size) == pytest.approx(size.min())


def test_boxes_that_only_touch_do_not_overlap():
    beside = transform_from([2.0, 0, 0], [1.0, 0, 0, 0])
    assert not boxes_overlap(np.eye(4), CUBE, beside, CUBE)
    assert boxes_overlap(np.eye(4), np.array([2.001, 2, 2]), beside, CUBE)


def test_penetration_is_the_depth_along_the_shallowest_axis():
    ahead = transform_from([3.0, 0.5, 0], [1.0, 0, 0, 0])
    assert box_penetration(np.eye(4), (4, 2, 2), ahead, (4, 2, 2)) == pytest.approx(1.0)
    assert box_penetration(np.eye(4), (1, 2, 2), ahead, (1, 2, 2)) == pytest.approx(-2.0)


def test_edges_that_cross_without_faces_meeting_are_apart():
    tilted = transform_from([0, 0, 0], [np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0])
    other = transform_from(
        [0, 0, 2 * np.sqrt(2) + 0.01], [np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0]
    )
    assert not boxes_overlap(tilted, CUBE, other, CUBE)
    other[2, 3] -= 0.02
    assert boxes_overlap(tilted, CUBE, other, CUBE)


def test_one_box_against_many():
    many = np.stack([transform_from([x, 0, 0], [1.0, 0, 0, 0]) for x in (0.0, 1.5, 2.5, -9)])
    depths = box_penetration(np.eye(4), (2, 2, 2), many, np.full((4, 3), 2.0))
    np.testing.assert_allclose(depths[:3], [2.0, 0.5, -0.5])
    assert depths[3] < 0


@pytest.mark.parametrize("flat", [False, True])
def test_boxes_overlap_where_they_reach_into_each_other(flat):
    rng = np.random.default_rng(3)
    quaternions = rng.normal(size=(2, 400, 4))
    if flat:
        quaternions[..., 1:3] = 0.0
    poses = transform_from(rng.normal(scale=1.5, size=(2, 400, 3)), quaternions)
    sizes = rng.uniform(0.2, 4.0, size=(2, 400, 3))
    deep = box_penetration(poses[0], sizes[0], poses[1], sizes[1]) > 0
    assert 0.1 < deep.mean() < 0.9
    pairs = zip(poses[0], sizes[0], poses[1], sizes[1], strict=True)
    assert [boxes_overlap(*pair) for pair in pairs] == deep.tolist()
