"""Status and migration of a store's schema from the command line."""

from __future__ import annotations

import sqlite3

import pytest

from real2sim_server.cli.store import migrate, status
from real2sim_server.console import CommandError
from real2sim_server.service.storage import schema
from real2sim_server.service.storage.connection import StoreError


@pytest.fixture
def data(tmp_path):
    """A state folder with a store."""
    migrate(data=tmp_path)
    return tmp_path


def write_version(data, version: str) -> None:
    connection = sqlite3.connect(data / "real2sim.db")
    connection.execute("UPDATE alembic_version SET version_num = ?", (version,))
    connection.commit()
    connection.close()


def test_migrate_creates_tables_once(tmp_path, capsys):
    migrate(data=tmp_path)
    assert f"done: {schema.SCHEMA_VERSION}: all tables" in capsys.readouterr().out
    migrate(data=tmp_path)
    assert "nothing to do" in capsys.readouterr().out


def test_status_lists_pending_migrations_without_applying_them(data, capsys, monkeypatch):
    capsys.readouterr()
    monkeypatch.setattr(schema, "SCHEMA_VERSION", 2)
    monkeypatch.setattr(schema, "_revisions", lambda: [(1, "first"), (2, "colours")])
    for _ in range(2):
        status(data=data)
        told = capsys.readouterr().out
        assert "schema 1; this program's is 2" in told
        assert "to do: 2: colours" in told
        assert "real2sim store migrate" in told


def test_a_store_with_a_newer_schema_is_refused_with_a_hint(data):
    write_version(data, "0099")
    for command in (status, migrate):
        with pytest.raises(StoreError, match="restore a backup"):
            command(data=data)


def test_a_folder_without_a_store_is_reported_and_not_created(tmp_path):
    with pytest.raises(CommandError, match="there is no store"):
        status(data=tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere").exists()


def test_an_unreachable_database_is_reported_without_its_password():
    with pytest.raises(CommandError) as told:
        status(url="postgresql+pg8000://me:secret@127.0.0.1:1/none")
    assert "secret" not in str(told.value)
