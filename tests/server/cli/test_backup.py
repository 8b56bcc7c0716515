"""Backup of a live worker, and restore."""

from __future__ import annotations

import tarfile
import threading
from pathlib import Path

import pytest

from real2sim_server.cli.store import backup, restore
from real2sim_server.console import CommandError
from real2sim_server.service.storage.backup import BackupError
from real2sim_server.service.storage.connection import StateFolderError, owned_folder
from real2sim_server.service.storage.store import ScenarioRow, Store

from ..service.storage.test_store import entry, run

ROW = ScenarioRow("sc_1", "first", "tiny", "0" * 64, 1)


@pytest.fixture
def data(tmp_path) -> Path:
    """A state folder with a scenario and an asset."""
    folder = tmp_path / "data"
    (folder / "assets" / "car.r2a").mkdir(parents=True)
    (folder / "assets" / "car.r2a" / "asset.json").write_text("{}")
    (folder / "assets" / ".upload-0123").mkdir()
    run(url_of(folder), lambda store: store.create_scenario(ROW))
    return folder


def url_of(folder: Path) -> str:
    return f"sqlite:///{folder / 'real2sim.db'}"


def revisions(folder: Path) -> int | None:
    newest = run(url_of(folder), lambda store: store.newest_of_scenario("sc_1"))
    return newest and newest[0]


def test_a_backup_during_writes_is_consistent(data, tmp_path):
    stop, written = threading.Event(), []

    async def write(store: Store) -> None:
        while not stop.is_set():
            number = len(written) + 1
            store.record_revision("sc_1", number, entry("x" * 500), created_us=1)
            written.append(number)

    writer = threading.Thread(target=run, args=(url_of(data), write))
    writer.start()
    try:
        while len(written) < 20:
            stop.wait(0.01)
        before = len(written)
        backup(tmp_path / "a.backup", data=data)
        after = len(written) + 1
    finally:
        stop.set()
        writer.join()
    restore(tmp_path / "a.backup", data=tmp_path / "new")
    assert before <= revisions(tmp_path / "new") <= after


def test_assets_are_backed_up_without_unfinished_ones(data, tmp_path):
    backup(tmp_path / "a.backup", data=data)
    restore(tmp_path / "a.backup", data=tmp_path / "new")
    assets = tmp_path / "new" / "assets"
    assert [p.name for p in assets.iterdir()] == ["car.r2a"]
    assert (assets / "car.r2a" / "asset.json").read_text() == "{}"


def test_backups_and_restored_stores_are_readable_by_their_owner_only(data, tmp_path):
    backup(tmp_path / "a.backup", data=data)
    restore(tmp_path / "a.backup", data=tmp_path / "new")
    for file in (tmp_path / "a.backup", tmp_path / "new" / "real2sim.db"):
        assert file.stat().st_mode & 0o077 == 0


def test_restoring_a_folder_in_use_is_refused(data, tmp_path):
    backup(tmp_path / "a.backup", data=data)
    with owned_folder(data), pytest.raises(StateFolderError, match="in use"):
        restore(tmp_path / "a.backup", data=data, overwrite=True)


def test_overwrite_replaces_an_existing_store_and_keeps_a_copy(data, tmp_path):
    backup(tmp_path / "a.backup", data=data)

    async def edit(store: Store) -> None:
        store.record_revision("sc_1", 1, entry("a"), created_us=1)

    run(url_of(data), edit)
    with pytest.raises(BackupError, match="--overwrite"):
        restore(tmp_path / "a.backup", data=data)
    assert revisions(data) == 1
    restore(tmp_path / "a.backup", data=data, overwrite=True)
    assert revisions(data) == 0
    (aside,) = data.glob("real2sim.db.before-*Z")
    newest = run(f"sqlite:///{aside}", lambda store: store.newest_of_scenario("sc_1"))
    assert newest is not None
    assert newest[0] == 1


def test_a_damaged_backup_is_refused_and_the_store_is_unchanged(data, tmp_path):
    backup(tmp_path / "a.backup", data=data)
    content = bytearray((tmp_path / "a.backup").read_bytes())
    content[len(content) // 2] ^= 0xFF
    (tmp_path / "a.backup").write_bytes(content)
    with pytest.raises(BackupError):
        restore(tmp_path / "a.backup", data=data, overwrite=True)
    assert revisions(data) == 0
    (tmp_path / "a.backup").write_bytes(b"no backup")
    with pytest.raises(BackupError, match="not a worker's backup"):
        restore(tmp_path / "a.backup", data=data, overwrite=True)


def test_a_backup_with_paths_outside_its_folder_is_refused(data, tmp_path):
    backup(tmp_path / "a.backup", data=data)
    evil = tmp_path / "evil"
    evil.write_text("x")
    with tarfile.open(tmp_path / "a.backup", "a") as tar:
        tar.add(evil, "assets/../../escaped")
        tar.add(evil, "/tmp/real2sim-escaped")
    with pytest.raises(BackupError):
        restore(tmp_path / "a.backup", data=tmp_path / "new")
    assert not (tmp_path / "escaped").exists()


def test_a_backup_does_not_overwrite_a_file(data, tmp_path):
    (tmp_path / "a.backup").write_text("mine")
    with pytest.raises(CommandError, match="exists already"):
        backup(tmp_path / "a.backup", data=data)


def test_a_database_server_is_refused_in_favour_of_pg_dump(monkeypatch, tmp_path):
    monkeypatch.setenv("REAL2SIM_STORE_URL", "postgresql+pg8000://user@host/name")
    with pytest.raises(CommandError, match="pg_dump"):
        backup(tmp_path / "a.backup")
