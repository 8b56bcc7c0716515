"""The kernels' 3x3 matrix functions compared with NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from real2sim_server.physics.numerics import eigen_symmetric, least_minor, square_root

SIX = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]


@pytest.fixture
def symmetric():
    turned = np.random.default_rng(3).normal(size=(200, 3, 3))
    return np.eye(3) + 0.02 * (turned + turned.transpose(0, 2, 1))


@pytest.mark.parametrize(("bound", "sign"), [(0.95, 1.0), (1.06, -1.0)])
def test_the_smallest_minor_tells_whether_eigenvalues_are_within_a_bound(symmetric, bound, sign):
    values = np.linalg.eigvalsh(symmetric)
    within = (sign * (values - bound) > 0).all(axis=1)
    assert 20 < within.sum() < 180
    found = [least_minor([m[at] for at in SIX], bound, sign) > 0 for m in symmetric]
    assert found == within.tolist()


def test_eigenvectors_match_numpy(symmetric):
    for m in symmetric[:20]:
        values, vectors = eigen_symmetric(tuple(m[at] for at in SIX))
        turn = np.array(vectors).reshape(3, 3)
        np.testing.assert_allclose(turn @ np.diag(values) @ turn.T, m, atol=1e-6)
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-6)


def test_kernel_square_roots_are_vectorised():
    """A C library call per number would keep flow from being vectorised."""

    @njit
    def rooted(values):
        for k in range(16):
            values[k] = square_root(values[k])

    values = np.arange(16, dtype=np.float32)
    rooted(values)
    np.testing.assert_allclose(values, np.sqrt(np.arange(16)), rtol=1e-7)
    (code,) = rooted.inspect_llvm().values()
    assert "llvm.sqrt" in code
    assert "@sqrtf" not in code
