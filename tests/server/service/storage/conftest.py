from __future__ import annotations

import pytest

from ..postgres import Postgres


@pytest.fixture
def sqlite_url(tmp_path) -> str:
    return f"sqlite:///{tmp_path / 'deep' / 'store.db'}"


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, sqlite_url) -> str:
    """An empty database of each kind; what holds for one holds for the other."""
    if request.param == "sqlite":
        return sqlite_url
    server: Postgres = request.getfixturevalue("postgres")
    return server.new_database()
