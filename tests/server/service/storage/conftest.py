from __future__ import annotations

import pytest

from ..postgres import Postgres


@pytest.fixture
def sqlite_url(tmp_path) -> str:
    return f"sqlite:///{tmp_path / 'deep' / 'store.db'}"


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, sqlite_url) -> str:
    """URL of an empty database of each kind."""
    if request.param == "sqlite":
        return sqlite_url
    server: Postgres = request.getfixturevalue("postgres")
    return server.new_database()
