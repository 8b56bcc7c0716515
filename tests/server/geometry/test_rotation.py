import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from real2sim_server.geometry import (
    is_rotation,
    matrix_to_quaternion,
    multiply_quaternions,
    quaternion_to_matrix,
    quaternion_yaw,
    slerp,
    yaw_quaternion,
)

from .strategies import quaternions

IDENTITY = np.array([1.0, 0, 0, 0])


def conjugate(quaternion: np.ndarray) -> np.ndarray:
    return quaternion * [1, -1, -1, -1]


def same_rotation(a: np.ndarray, b: np.ndarray) -> bool:
    """Quaternions q and -q are one rotation."""
    return bool(abs(abs(np.dot(a, b)) - 1) < 1e-12)


@given(quaternions)
def test_matrix_of_a_quaternion_is_a_rotation(q):
    assert is_rotation(quaternion_to_matrix(q), tolerance=1e-12)


@given(quaternions)
def test_matrix_and_quaternion_round_trip(q):
    back = matrix_to_quaternion(quaternion_to_matrix(q))
    assert back[0] >= 0
    assert min(np.abs(back - q).max(), np.abs(back + q).max()) < 1e-12


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_round_trip(axis):
    half_turn = 2 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(quaternion_to_matrix(matrix_to_quaternion(half_turn)), half_turn)


@given(quaternions)
def test_a_quaternion_times_its_inverse_is_the_identity(q):
    np.testing.assert_allclose(multiply_quaternions(q, conjugate(q)), IDENTITY, atol=1e-12)


@given(quaternions, quaternions, quaternions)
def test_multiplication_is_associative(a, b, c):
    left = multiply_quaternions(multiply_quaternions(a, b), c)
    right = multiply_quaternions(a, multiply_quaternions(b, c))
    np.testing.assert_allclose(left, right, atol=1e-12)


@given(quaternions, quaternions)
def test_product_of_quaternions_is_the_product_of_matrices(a, b):
    np.testing.assert_allclose(
        quaternion_to_matrix(multiply_quaternions(a, b)),
        quaternion_to_matrix(a) @ quaternion_to_matrix(b),
        atol=1e-12,
    )


@given(quaternions, quaternions)
def test_slerp_meets_its_end_points(a, b):
    assert same_rotation(slerp(a, b, 0.0), a)
    assert same_rotation(slerp(a, b, 1.0), b)


@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp_takes_the_shortest_arc_at_constant_speed(a, b, fraction):
    whole = 2 * np.arccos(min(1.0, abs(np.dot(a, b))))
    part = 2 * np.arccos(min(1.0, abs(np.dot(a, slerp(a, b, fraction)))))
    assert part == pytest.approx(fraction * whole, abs=1e-6)


@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp_does_not_depend_on_quaternion_sign(a, b, fraction):
    if abs(np.dot(a, b)) > 1e-6:
        assert same_rotation(slerp(a, b, fraction), slerp(a, -b, fraction))


def test_slerp_of_yaws_is_linear_in_the_angle():
    q = slerp(yaw_quaternion(0.2), yaw_quaternion(1.4), np.array([0.0, 0.25, 1.0]))
    np.testing.assert_allclose(quaternion_yaw(q), [0.2, 0.5, 1.4])


@given(st.floats(-3.14, 3.14))
def test_yaw_round_trips(yaw):
    assert quaternion_yaw(yaw_quaternion(yaw)) == pytest.approx(yaw, abs=1e-12)


def test_batches_are_treated_one_by_one():
    q = np.random.default_rng(0).normal(size=(3, 2, 4))
    matrices = quaternion_to_matrix(q)
    assert matrices.shape == (3, 2, 3, 3)
    np.testing.assert_array_equal(matrices[1, 1], quaternion_to_matrix(q[1, 1]))
    np.testing.assert_array_equal(
        matrix_to_quaternion(matrices)[2, 0], matrix_to_quaternion(matrices[2, 0])
    )


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([1.0, 1, -1]),
        np.eye(3) * 1.01,
        np.full((3, 3), np.nan),
        np.eye(4),
        np.full((3, 3), 1e200),
        np.zeros((3, 3)),
    ],
)
def test_non_rotations_are_recognised(matrix):
    assert not is_rotation(matrix)
