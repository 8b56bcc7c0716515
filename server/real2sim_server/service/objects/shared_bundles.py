"""Bundles that workers share: folders of files, which one puts into a store of objects, and another
takes out when it needs them.

The database says what there is (``shared_bundles``: a kind, a name, its files with their digests),
the store of objects has the contents. What a worker has taken out lies in its own folders like what
it made itself, marked by a hidden file, and goes when there is too much of it, in the order of its
last use.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa
import structlog

from ..._files import atomic_folder
from ..clock import now_us
from ..storage import schema as t
from ..storage.fleet import notice
from ..storage.store import ConflictError, Store, Write
from .object_store import PIECE_BYTES, ObjectStore, ObjectStoreError

MARK = ".taken-out"
"""File of a bundle that came out of the store of objects; its time is that of the last use."""
UNREFERENCED_S = 24 * 3600.0
"""Age from which on an object that no bundle has is removed."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class BundleFile:
    """A file of a bundle.

    Attributes:
        path: below the bundle's folder, with ``/``.
        digest: SHA-256 of its content.
        bytes: size.
    """

    path: str
    digest: str
    bytes: int


@dataclass(frozen=True)
class SharedBundle:
    """A bundle as the database has it.

    Attributes:
        kind: ``scene``, ``asset`` or ``job``.
        name: of the scene, asset or job.
        folder: its name on the disk.
        files: what it is made of.
    """

    kind: str
    name: str
    folder: str
    files: tuple[BundleFile, ...]

    @property
    def bytes(self) -> int:
        """Size of all files."""
        return sum(file.bytes for file in self.files)

    @property
    def content(self) -> str:
        """Digest of what is in it."""
        return hashlib.sha256(self.document().encode()).hexdigest()

    def document(self) -> str:
        """Folder and files as JSON."""
        files = [[file.path, file.digest, file.bytes] for file in self.files]
        return json.dumps({"folder": self.folder, "files": files})

    @classmethod
    def of_document(cls, kind: str, name: str, document: str) -> SharedBundle:
        """The bundle of a row."""
        values = json.loads(document)
        return cls(kind, name, values["folder"], tuple(BundleFile(*f) for f in values["files"]))


class BundleFolders:
    """Puts folders into a store of objects and takes them out. For threads that may wait.

    Args:
        objects: the store.
        folders: of bundles, by kind.
        max_bytes: that what was taken out may take on the disk.
    """

    def __init__(
        self, objects: ObjectStore, folders: Mapping[str, Path], *, max_bytes: int
    ) -> None:
        self.objects = objects
        self._folders = folders
        self._max_bytes = max_bytes
        self._lock = threading.Lock()

    def own(self, kind: str) -> list[Path]:
        """Bundles of a kind that were made here."""
        return [path for path in self._all(kind) if not (path / MARK).exists()]

    def put(self, kind: str, name: str, folder: Path) -> SharedBundle:
        """Put the files of a folder into the store; those of a job without its workshop below.

        Raises:
            ObjectStoreError: the store cannot be used.
            OSError: the folder cannot be read.
        """
        files = []
        for path in sorted(folder.iterdir() if kind == "job" else folder.rglob("*")):
            below = path.relative_to(folder)
            if path.is_file() and not any(part.startswith(".") for part in below.parts):
                digest = digest_of(path)
                self.objects.put(path, digest)
                files.append(BundleFile(below.as_posix(), digest, path.stat().st_size))
        return SharedBundle(kind, name, folder.name, tuple(files))

    def take_out(self, bundle: SharedBundle) -> Path:
        """The folder of a bundle, fetched where it is not there.

        Raises:
            ObjectStoreError: the store cannot be used, or what it has is damaged.
            OSError: the disk takes nothing.
        """
        target = self._folders[bundle.kind] / bundle.folder
        with self._lock:
            mark = target / MARK
            if target.is_dir() and (not mark.exists() or mark.read_text() == bundle.content):
                mark_used(target)
                return target
            self._make_room(bundle.bytes)
            began = time.monotonic()
            with atomic_folder(target) as staging:
                for file in bundle.files:
                    self._fetch(file, _inside(staging, file.path))
                (staging / MARK).write_text(bundle.content)
        seconds = round(time.monotonic() - began, 3)
        log.info(
            "bundle taken out",
            kind=bundle.kind,
            name=bundle.name,
            bytes=bundle.bytes,
            seconds=seconds,
        )
        return target

    def sweep(self, wanted: set[str]) -> int:
        """Remove objects that no bundle has and that nobody has put for a day; how many.

        Args:
            wanted: digests of all bundles.

        Raises:
            ObjectStoreError: the store cannot be used.
        """
        left = [
            one.digest
            for one in self.objects.list()
            if one.digest not in wanted and one.age_s > UNREFERENCED_S
        ]
        for digest in left:
            self.objects.remove(digest)
        return len(left)

    # --- inside -----------------------------------------------------------------------------

    def _all(self, kind: str) -> Iterator[Path]:
        folder = self._folders[kind]
        if folder.is_dir():
            yield from (p for p in sorted(folder.iterdir()) if p.is_dir() and p.name[0] != ".")

    def _make_room(self, more: int) -> None:
        taken = [p for kind in self._folders for p in self._all(kind) if (p / MARK).exists()]
        sizes = {
            path: sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) for path in taken
        }
        held = sum(sizes.values())
        for path in sorted(taken, key=lambda p: (p / MARK).stat().st_mtime):
            if held + more <= self._max_bytes:
                return
            # Whoever has its files open or mapped keeps them.
            shutil.rmtree(path, ignore_errors=True)
            held -= sizes[path]
            log.info("bundle dropped", folder=path.name, bytes=sizes[path])

    def _fetch(self, file: BundleFile, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        seen = hashlib.sha256()
        with target.open("xb") as kept:
            for start in range(0, file.bytes, PIECE_BYTES):
                end = min(start + PIECE_BYTES, file.bytes)
                piece = self.objects.read(file.digest, start, end)
                seen.update(piece)
                kept.write(piece)
        if seen.hexdigest() != file.digest:
            raise ObjectStoreError(f"the object of {file.path!r} is damaged or cut short")


def mark_used(folder: Path) -> None:
    """Note that a bundle is in use: of those that were taken out others go before it."""
    with contextlib.suppress(FileNotFoundError):
        os.utime(folder / MARK)


def digest_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _inside(folder: Path, path: str) -> Path:
    target = (folder / path).resolve()
    if not target.is_relative_to(folder.resolve()):
        raise ObjectStoreError(f"{path!r} leads out of its bundle")
    return target


# --- Bundles in the store ------------------------------------------------------------------------


@dataclass(frozen=True)
class BundleRow:
    """A bundle on record.

    Attributes:
        kind: ``scene``, ``asset`` or ``job``.
        name: of the scene, asset or job.
        content: digest of all that is in it.
        document: its files and their digests, JSON.
        bytes: of all files.
        created_us: when it was put on record, or deleted.
    """

    kind: str
    name: str
    content: str
    document: str
    bytes: int
    created_us: int = 0

    @property
    def deleted(self) -> bool:
        """Whether it was deleted: whoever has a copy of before removes it."""
        return not self.content


class BundleLog:
    """Bundles beyond the folders of one worker.

    Args:
        store: open while this is used.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    async def add(self, row: BundleRow) -> bool:
        """Put a bundle on record; False where there is one of that name, which stays."""
        values = vars(row) | {"created_us": now_us()}
        with contextlib.suppress(ConflictError):
            await self._store.write(Write(sa.insert(t.shared_bundles), [values]), *self._notice())
            return True
        deleted = self._is(row.kind, row.name) & (t.shared_bundles.c.content == "")
        change = sa.update(t.shared_bundles).where(deleted).values(values)
        counts = await self._store.write(Write(change), *self._notice())
        return counts[0] > 0

    async def get(self, kind: str, name: str) -> BundleRow | None:
        """The bundle of that name."""
        rows = await self._rows(self._is(kind, name))
        return rows[0] if rows else None

    async def all(self) -> list[BundleRow]:
        """All bundles."""
        return await self._rows(sa.true())

    async def state(self) -> tuple[int, int]:
        """Changes whenever a bundle comes or goes."""
        b = t.shared_bundles.c
        newest = sa.func.coalesce(sa.func.max(b.created_us), 0).label("newest")
        query = sa.select(sa.func.count().label("many"), newest).select_from(t.shared_bundles)
        (row,) = await self._store.read(query)
        return int(row["many"]), int(row["newest"])

    async def mark_deleted(self, kind: str, name: str) -> None:
        """Leave word that a bundle was deleted."""
        empty = {"content": "", "document": "", "bytes": 0, "created_us": now_us()}
        change = sa.update(t.shared_bundles).where(self._is(kind, name)).values(empty)
        await self._store.write(Write(change), *self._notice())

    async def remove(self, kind: str, name: str) -> None:
        """Forget a bundle."""
        gone = Write(sa.delete(t.shared_bundles).where(self._is(kind, name)))
        await self._store.write(gone, *self._notice())

    def _notice(self) -> list[Write]:
        return notice("bundles", on_server=self._store.database.is_server)

    async def _rows(self, condition: sa.ColumnElement[bool]) -> list[BundleRow]:
        b = t.shared_bundles.c
        query = sa.select(b.kind, b.name, b.content, b.document, b.bytes, b.created_us)
        query = query.where(condition)
        return [BundleRow(**row) for row in await self._store.read(query)]

    @staticmethod
    def _is(kind: str, name: str) -> sa.ColumnElement[bool]:
        b = t.shared_bundles.c
        return (b.kind == kind) & (b.name == name)
