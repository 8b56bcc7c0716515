"""All simulation tests use a single torch thread."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def few_threads(one_torch_thread):
    """See ``tests/server/conftest.py``."""
