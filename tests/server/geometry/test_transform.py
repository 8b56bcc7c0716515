import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from real2sim_server.geometry import (
    apply_transform,
    invert_transform,
    is_rigid,
    transform_from,
)

from .strategies import quaternions, vectors


@given(vectors, quaternions, arrays(np.float64, (5, 3), elements=st.floats(-100, 100)))
def test_a_transform_and_its_inverse_bring_points_back(position, quaternion, points):
    transform = transform_from(position, quaternion)
    there = apply_transform(transform, points)
    np.testing.assert_allclose(
        apply_transform(invert_transform(transform), there), points, atol=1e-9
    )


@pytest.mark.parametrize("place", [(3, 0), (0, 3)])
def test_a_transform_with_a_bad_entry_is_not_rigid(place):
    matrix = np.eye(4)
    assert is_rigid(matrix)
    matrix[place] = np.inf
    assert not is_rigid(matrix)
