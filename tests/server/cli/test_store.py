"""The schema of a store, looked at and brought up to date from the command line."""

from __future__ import annotations

import sqlite3

import pytest

from real2sim_server.cli.store import migrate, status
from real2sim_server.console import CommandError
from real2sim_server.service.storage import tables
from real2sim_server.service.storage.errors import StoreError

from ..service.storage.test_migrations import write_version_1


@pytest.fixture
def data(tmp_path):
    """A state folder with a store of the first schema."""
    write_version_1(f"sqlite:///{tmp_path / 'real2sim.db'}")
    return tmp_path


def test_what_would_be_done_is_told_and_not_done(data, capsys):
    for _ in range(2):
        status(data=data)
        told = capsys.readouterr().out
        assert f"schema 1; this program's is {tables.SCHEMA_VERSION}" in told
        assert told.count("to do:") == tables.SCHEMA_VERSION - 1
        assert "real2sim store migrate" in told


def test_a_store_is_brought_up_to_date_once(data, capsys):
    migrate(data=data)
    assert capsys.readouterr().out.count("done:") == tables.SCHEMA_VERSION - 1
    migrate(data=data)
    assert "nothing to do" in capsys.readouterr().out


def test_a_store_of_a_newer_program_is_refused_with_what_to_do(data):
    migrate(data=data)
    connection = sqlite3.connect(data / "real2sim.db")
    connection.execute("INSERT INTO schema_version VALUES (99)")
    connection.commit()
    connection.close()
    for command in (status, migrate):
        with pytest.raises(StoreError, match="restore a backup"):
            command(data=data)


def test_a_folder_without_a_store_is_told_of(tmp_path):
    with pytest.raises(CommandError, match="there is no store"):
        status(data=tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere").exists()


def test_a_database_that_cannot_be_reached_is_told_of_without_its_password():
    with pytest.raises(CommandError) as told:
        status(url="postgresql+pg8000://me:secret@127.0.0.1:1/none")
    assert "secret" not in str(told.value)
