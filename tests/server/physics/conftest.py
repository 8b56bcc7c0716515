"""Every test of the solver has one thread of torch."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def few_threads(one_torch_thread):
    """See ``tests/server/conftest.py``."""
