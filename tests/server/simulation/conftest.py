"""Every test of simulations has compiled kernels, and one thread of torch."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def solver_ready(solver_kernels, one_torch_thread):
    """See the fixtures of ``tests/server``."""
