"""Backups of a worker's store: made while it runs, restored while no worker runs.

A backup is one tar file: metadata (`backup.json`), the database, and the bundles of the assets
that scenarios may refer to. It does not include scenes and job results, which are plain files.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import sqlite3
import tarfile
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path, PurePosixPath

from ..._files import unpack_tar
from . import schema as t
from .connection import StoreError, owned_folder
from .schema import check_version

MANIFEST = "backup.json"
DATABASE = "store.db"
ASSETS = "assets"
FORMAT = 1
RESTORING = ".restore-"
"""Name prefix of temporary folders in a state folder."""


class BackupError(StoreError):
    """A backup cannot be made or restored; the message states the reason and the remedy."""


@dataclass(frozen=True)
class BackupInfo:
    """Metadata of a backup.

    Attributes:
        format: format of the file.
        created_at: UTC, ISO 8601.
        made_by: version of this program.
        schema: schema version of the database.
        sha256: hash of the database.
        assets: asset bundles in the backup.
    """

    format: int
    created_at: str
    made_by: str
    schema: int
    sha256: str
    assets: int


def make_backup(database: Path, assets: Path, out: Path) -> BackupInfo:
    """Copy a consistent snapshot of a store to a file, even while a worker writes to it.

    Args:
        database: SQLite file.
        assets: folder of asset bundles; it need not exist.
        out: new tar file; must not exist.

    Raises:
        BackupError: the database does not exist, or the copy is damaged.
        OSError: ``out`` cannot be written.
    """
    if not database.is_file():
        raise BackupError(f"there is no store at {str(database)!r}; name its folder with --data")
    with tempfile.TemporaryDirectory(prefix=".backup-", dir=out.parent) as folder:
        copy = Path(folder) / DATABASE
        _copy_database(database, copy)
        # Assets follow the database: those it refers to already exist and never change.
        bundles = [path for path in sorted(assets.glob("[!.]*")) if path.is_dir()]
        info = BackupInfo(
            format=FORMAT,
            created_at=datetime.now(UTC).isoformat(timespec="seconds"),
            made_by=version("real2sim"),
            schema=_checked_schema(copy),
            sha256=_sha256(copy),
            assets=len(bundles),
        )
        packed = Path(folder) / "backup.tar"
        with tarfile.open(packed, "x", format=tarfile.PAX_FORMAT) as tar:
            _add_bytes(tar, MANIFEST, (json.dumps(asdict(info), indent=2) + "\n").encode())
            tar.add(copy, DATABASE)
            for bundle in bundles:
                tar.add(bundle, f"{ASSETS}/{bundle.name}")
        packed.chmod(0o600)
        with packed.open("rb") as file:
            os.fsync(file.fileno())
        # This does not overwrite a file that was created in the meantime.
        os.link(packed, out)
    return info


def restore_backup(file: Path, data: Path, *, database: Path, assets: Path, replace: bool) -> Path:
    """Restore a backup; an existing store is moved aside.

    Args:
        file: file written by :func:`make_backup`.
        data: state folder, not in use by a worker.
        database: SQLite file to create.
        assets: folder that receives missing bundles.
        replace: whether an existing store may be replaced.

    Returns:
        The new path of the old store; ``database`` if there was none.

    Raises:
        BackupError: the file is not a backup, damaged or too new, or a store already exists.
        StateFolderError: a worker uses the state folder.
        OSError: a file cannot be written.
    """
    if not file.is_file():
        raise BackupError(f"there is no file {str(file)!r}")
    with owned_folder(data), _unpacked(file, data) as folder:
        copy = folder / DATABASE
        check_version(_checked_schema(copy))
        aside = database
        if database.exists():
            if not replace:
                raise BackupError(
                    f"there is a store at {str(database)!r} already; give --overwrite to put it "
                    "aside, or another folder with --data"
                )
            aside = _move_aside(database)
        copy.chmod(0o600)
        database.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(copy, database)
        _add_missing(folder / ASSETS, assets)
    return aside


def _copy_database(source: Path, target: Path) -> None:
    os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    with (
        contextlib.closing(sqlite3.connect(f"{source.as_uri()}?mode=ro", uri=True)) as reading,
        contextlib.closing(sqlite3.connect(target)) as writing,
    ):
        try:
            # Copying in one step finishes even while a worker writes, and does not block writers.
            reading.backup(writing, pages=-1)
            writing.execute("PRAGMA journal_mode=DELETE")
        except sqlite3.Error as error:
            raise BackupError(f"the store {str(source)!r} cannot be copied: {error}") from error


def _checked_schema(database: Path) -> int:
    """Schema version of a copy. Raises BackupError if the copy is damaged."""
    with contextlib.closing(sqlite3.connect(database)) as connection:
        try:
            (state,) = connection.execute("PRAGMA quick_check(1)").fetchone()
            (found,) = connection.execute(
                f"SELECT max(CAST(version_num AS INTEGER)) FROM {t.alembic_version.name}"
            ).fetchone()
        except sqlite3.Error as error:
            raise BackupError(f"{database.name} is not a worker's store: {error}") from error
    if state != "ok" or found is None:
        raise BackupError(f"{database.name} is damaged: {state}")
    return int(found)


@contextlib.contextmanager
def _unpacked(file: Path, beside: Path) -> Iterator[Path]:
    """The verified contents of a backup, in a folder that is removed after the block."""
    with tempfile.TemporaryDirectory(prefix=RESTORING, dir=beside) as name:
        folder = Path(name)
        try:
            with tarfile.open(file, "r:") as tar:
                members = [member for member in tar if _belongs(member)]
                unpack_tar(tar, folder, members=members)
            told = json.loads((folder / MANIFEST).read_text("utf-8"))
            info = BackupInfo(**told)
        except (tarfile.TarError, OSError, ValueError, TypeError) as error:
            raise BackupError(f"{str(file)!r} is not a worker's backup: {error}") from error
        if info.format != FORMAT:
            raise BackupError(
                f"{str(file)!r} has format {info.format}, this program reads {FORMAT}; use "
                f"real2sim {info.made_by}"
            )
        if not (folder / DATABASE).is_file() or _sha256(folder / DATABASE) != info.sha256:
            raise BackupError(f"{str(file)!r} is damaged: the hash of its store differs")
        yield folder


def _belongs(member: tarfile.TarInfo) -> bool:
    path = PurePosixPath(member.name)
    if member.name in (MANIFEST, DATABASE):
        return member.isfile()
    return path.parts[:1] == (ASSETS,) and (member.isfile() or member.isdir())


def _move_aside(database: Path) -> Path:
    """Move a store aside, including its journal."""
    with (
        contextlib.closing(sqlite3.connect(database)) as connection,
        contextlib.suppress(sqlite3.Error),
    ):
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    aside = database.with_name(f"{database.name}.before-{stamp}")
    for end in ("-wal", "-shm"):
        journal = database.with_name(database.name + end)
        if journal.exists():
            journal.replace(aside.with_name(aside.name + end))
    return database.replace(aside)


def _add_missing(bundles: Path, assets: Path) -> None:
    """Copy missing assets. Assets never change, so existing ids have the same content."""
    if not bundles.is_dir():
        return
    assets.mkdir(parents=True, exist_ok=True)
    for bundle in sorted(bundles.iterdir()):
        if not (assets / bundle.name).exists():
            shutil.move(bundle, assets / bundle.name)


def _sha256(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _add_bytes(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.mode = len(content), 0o600
    tar.addfile(member, io.BytesIO(content))
