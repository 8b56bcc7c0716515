from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.scene.ground_fit import pull_push


def test_pull_push_keeps_known_values_and_their_range():
    rng = np.random.default_rng(0)
    values = rng.uniform(2, 3, (13, 22, 2)).astype(np.float32)
    weights = (rng.uniform(size=(13, 22)) < 0.1).astype(np.float32)
    filled = pull_push(values, weights)
    np.testing.assert_array_equal(filled[weights == 1], values[weights == 1])
    assert filled.min() >= 2 - 1e-5
    assert filled.max() <= 3 + 1e-5


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (8, 8)])
def test_pull_push_of_a_constant_is_that_constant(shape):
    weights = np.zeros(shape, np.float32)
    weights[0, 0] = 1
    filled = pull_push(np.full((*shape, 1), 4, np.float32), weights)
    np.testing.assert_allclose(filled, 4, rtol=1e-6)
