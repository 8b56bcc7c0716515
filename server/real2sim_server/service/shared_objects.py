"""Objects shared by workers: scene and asset bundles and job files, stored by content."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Protocol
from urllib.parse import parse_qsl, unquote, urlsplit

import sqlalchemy as sa
import structlog

from .._files import atomic_file, atomic_folder
from .clock import now_us
from .storage import schema as t
from .storage.fleet import notice
from .storage.store import ConflictError, Store, Write

if TYPE_CHECKING:
    from obstore.store import S3Store


# --- Object store ---------------------------------------------------------------------------------

# Files are named by the SHA-256 of their content, so an object never changes. A store may be slow
# or unreachable: call it only on threads that may block.

DIGEST = re.compile(r"[0-9a-f]{64}")
FRESH_S = 12 * 3600.0
"""Age above which a put writes the object again, to renew its age [s]."""
RETRIES = 3
"""Number of retries of a request that timed out or that a busy store refused."""
PIECE_BYTES = 4 << 20
"""Size of one read from a store [bytes]."""


class ObjectStoreError(Exception):
    """The object store fails or does not have the object; the call had no effect."""


@dataclass(frozen=True)
class StoredObject:
    """An object in a store.

    Attributes:
        digest: SHA-256 of its content, hexadecimal.
        bytes: size.
        age_s: time since it was last put [s].
    """

    digest: str
    bytes: int
    age_s: float


class ObjectStore(Protocol):
    """An object store. Thread-safe, but not for the event loop.

    Every method raises :class:`ObjectStoreError` if the store fails.
    """

    def put(self, file: Path, digest: str) -> None:
        """Store the content of a file whose digest is known."""

    def read(self, digest: str, start: int, end: int) -> bytes:
        """Bytes ``start`` to ``end`` of an object, end-exclusive."""

    def find(self, digest: str) -> StoredObject | None:
        """Metadata of an object; None if the store does not have it."""

    def signed_url(self, digest: str, seconds: float) -> str | None:
        """A temporary public URL of the object; None if not supported."""

    def list(self) -> Iterator[StoredObject]:
        """All objects, in any order."""

    def remove(self, digest: str) -> None:
        """Delete an object; no effect if it does not exist."""


def open_objects(url: str) -> ObjectStore:
    """The store at a URL.

    Args:
        url: ``file:///shared/objects``, or ``s3://bucket/prefix`` with ``endpoint`` and ``region``
            as a query for services other than AWS; keys come from ``AWS_ACCESS_KEY_ID`` and
            ``AWS_SECRET_ACCESS_KEY``, or from the machine's role.

    Raises:
        ValueError: another URL, or obstore is not installed.
    """
    parts = urlsplit(url)
    if parts.scheme == "file" and parts.path:
        return FolderObjects(Path(unquote(parts.path)))
    if parts.scheme == "s3" and parts.netloc:
        options = dict(parse_qsl(parts.query))
        if unknown := options.keys() - {"endpoint", "region"}:
            raise ValueError(f"{sorted(unknown)} in {url!r}: only endpoint and region are known")
        return S3Objects(parts.netloc, parts.path.strip("/"), **options)
    raise ValueError(
        f"{url!r} is not an object store: give file:///folder, or "
        "s3://bucket/prefix?endpoint=https://host&region=name"
    )


class FolderObjects:
    """Objects as files of a folder, shared by workers on one machine or file system.

    Args:
        folder: folder of the objects; created with the first object.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, file: Path, digest: str) -> None:
        """Store the content of a file."""
        path = self._path(digest)
        try:
            if path.is_file():
                os.utime(path)
                return
            with atomic_file(path) as kept, file.open("rb") as source:
                shutil.copyfileobj(source, kept, PIECE_BYTES)
        except OSError as error:
            raise _unusable(error) from error

    def read(self, digest: str, start: int, end: int) -> bytes:
        """Part of an object."""
        try:
            with self._path(digest).open("rb") as file:
                file.seek(start)
                return file.read(end - start)
        except OSError as error:
            raise _unusable(error) from error

    def find(self, digest: str) -> StoredObject | None:
        """Metadata of an object."""
        path = self._path(digest)
        try:
            found = path.stat()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unusable(error) from error
        return StoredObject(digest, found.st_size, time.time() - found.st_mtime)

    def signed_url(self, digest: str, seconds: float) -> str | None:
        """None: only workers can access the folder."""
        return None

    def list(self) -> Iterator[StoredObject]:
        """All objects."""
        for path in self._folder.glob("??/*"):
            if DIGEST.fullmatch(path.name) and (found := self.find(path.name)) is not None:
                yield found

    def remove(self, digest: str) -> None:
        """Delete an object."""
        try:
            self._path(digest).unlink(missing_ok=True)
        except OSError as error:
            raise _unusable(error) from error

    def _path(self, digest: str) -> Path:
        return self._folder / digest[:2] / _checked(digest)


class S3Objects:
    """Objects in an S3 bucket, or in a compatible service.

    Args:
        bucket: its name.
        prefix: prefix of the objects' names.
        endpoint: address of the service; default: AWS.
        region: region of the bucket.

    Raises:
        ValueError: obstore is not installed, or refuses the options.
    """

    def __init__(
        self, bucket: str, prefix: str = "", *, endpoint: str = "", region: str = ""
    ) -> None:
        try:
            from obstore import exceptions
            from obstore.store import S3Store
        except ImportError as error:
            raise ValueError(
                "an object store needs obstore: pip install 'real2sim[objects]'"
            ) from error
        options = {"endpoint": endpoint, "region": region}
        given = {name: value for name, value in options.items() if value}
        try:
            self._store: S3Store = S3Store(
                bucket,
                prefix=prefix or None,
                client_options={
                    "timeout": timedelta(seconds=60),
                    "connect_timeout": timedelta(seconds=5),
                    "allow_http": endpoint.startswith("http://"),
                },
                retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=30)},
                **given,  # type: ignore[arg-type]
            )
        except exceptions.BaseError as error:
            raise ValueError(f"the bucket {bucket!r} cannot be used: {error}") from error

    def put(self, file: Path, digest: str) -> None:
        """Store the content of a file."""
        import obstore

        found = self.find(digest)
        if found is not None and found.age_s < FRESH_S:
            return
        with _refusals():
            obstore.put(self._store, _key(digest), file)

    def read(self, digest: str, start: int, end: int) -> bytes:
        """Part of an object."""
        import obstore

        if end <= start:
            return b""
        with _refusals():
            return bytes(obstore.get_range(self._store, _key(digest), start=start, end=end))

    def find(self, digest: str) -> StoredObject | None:
        """Metadata of an object."""
        import obstore

        try:
            with _refusals():
                found = obstore.head(self._store, _key(digest))
        except FileNotFoundError:
            return None
        return _stored(found)

    def signed_url(self, digest: str, seconds: float) -> str | None:
        """A temporary public URL."""
        import obstore

        with _refusals():
            return obstore.sign(self._store, "GET", _key(digest), timedelta(seconds=seconds))

    def list(self) -> Iterator[StoredObject]:
        """All objects."""
        import obstore

        with _refusals():
            for some in obstore.list(self._store):
                yield from (_stored(one) for one in some if DIGEST.search(str(one["path"])))

    def remove(self, digest: str) -> None:
        """Delete an object."""
        import obstore

        with _refusals():
            obstore.delete(self._store, _key(digest))


class _refusals:
    """Convert errors of the client, except for missing objects."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        from obstore import exceptions

        if isinstance(error, exceptions.BaseError) and not isinstance(error, FileNotFoundError):
            raise ObjectStoreError(str(error).splitlines()[0]) from error


def _stored(found: object) -> StoredObject:
    about: dict[str, object] = found  # type: ignore[assignment]
    written = about["last_modified"].timestamp()  # type: ignore[attr-defined]
    name, size = str(about["path"]), int(str(about["size"]))
    return StoredObject(name.rpartition("/")[2], size, time.time() - written)


def _key(digest: str) -> str:
    return f"{digest[:2]}/{_checked(digest)}"


def _checked(digest: str) -> str:
    if not DIGEST.fullmatch(digest):
        raise ValueError(f"{digest!r} is not an SHA-256 in lower case")
    return digest


def _unusable(error: OSError) -> ObjectStoreError:
    return ObjectStoreError(f"the folder of objects: {error.strerror or error}")


# --- Shared bundles -------------------------------------------------------------------------------

# The database lists bundles (``shared_bundles``: kind, name, files with digests); the object store
# has the contents. A worker stores fetched bundles in its folders, marked by a hidden file, and
# deletes the least recently used ones when they exceed the limit.

MARK = ".taken-out"
"""Marker file of a bundle from the object store; its time is that of the last use."""
UNREFERENCED_S = 24 * 3600.0
"""Age after which an unused object is deleted [s]."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class BundleFile:
    """A file of a bundle.

    Attributes:
        path: relative to the bundle's folder, with ``/``.
        digest: SHA-256 of its content.
        bytes: size.
    """

    path: str
    digest: str
    bytes: int


@dataclass(frozen=True)
class SharedBundle:
    """A bundle in the database.

    Attributes:
        kind: ``scene``, ``asset`` or ``job``.
        name: name of the scene, asset or job.
        folder: name of its folder on disk.
        files: its files.
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
        """Digest of its content."""
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
    """Uploads folders to an object store and downloads them. For threads that may block.

    Args:
        objects: the store.
        folders: folders of bundles, by kind.
        max_bytes: disk space limit for downloaded bundles.
    """

    def __init__(
        self, objects: ObjectStore, folders: Mapping[str, Path], *, max_bytes: int
    ) -> None:
        self.objects = objects
        self._folders = folders
        self._max_bytes = max_bytes
        self._lock = threading.Lock()

    def own(self, kind: str) -> list[Path]:
        """Local bundles of a kind, without downloaded ones."""
        return [path for path in self._all(kind) if not (path / MARK).exists()]

    def put(self, kind: str, name: str, folder: Path) -> SharedBundle:
        """Upload the files of a folder; for a job, only those at the top level.

        Raises:
            ObjectStoreError: the store fails.
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
        """The folder of a bundle, downloaded if missing.

        Raises:
            ObjectStoreError: the store fails, or its data is damaged.
            OSError: the disk is full or fails.
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
        """Delete objects that no bundle uses and that were not put for a day; returns their
        number.

        Args:
            wanted: digests of all bundles.

        Raises:
            ObjectStoreError: the store fails.
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
            # Deleted files stay available to processes that have them open or mapped.
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
    """Mark a bundle as recently used; less recently used ones are deleted first."""
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
    """A listed bundle.

    Attributes:
        kind: ``scene``, ``asset`` or ``job``.
        name: name of the scene, asset or job.
        content: digest of its content.
        document: its files and their digests, JSON.
        bytes: size of all files.
        created_us: time at which it was listed, or deleted.
    """

    kind: str
    name: str
    content: str
    document: str
    bytes: int
    created_us: int = 0

    @property
    def deleted(self) -> bool:
        """Whether the bundle was deleted; workers then delete their copies."""
        return not self.content


class BundleLog:
    """The list of shared bundles.

    Args:
        store: an open store.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    async def add(self, row: BundleRow) -> bool:
        """Add a bundle. Returns False, without changes, if the name exists."""
        values = vars(row) | {"created_us": now_us()}
        with contextlib.suppress(ConflictError):
            await self._store.write(Write(sa.insert(t.shared_bundles), [values]), *self._notice())
            return True
        deleted = self._is(row.kind, row.name) & (t.shared_bundles.c.content == "")
        change = sa.update(t.shared_bundles).where(deleted).values(values)
        counts = await self._store.write(Write(change), *self._notice())
        return counts[0] > 0

    async def get(self, kind: str, name: str) -> BundleRow | None:
        """The bundle with that name."""
        rows = await self._rows(self._is(kind, name))
        return rows[0] if rows else None

    async def all(self) -> list[BundleRow]:
        """All bundles."""
        return await self._rows(sa.true())

    async def state(self) -> tuple[int, int]:
        """A value that changes whenever a bundle is added or removed."""
        b = t.shared_bundles.c
        newest = sa.func.coalesce(sa.func.max(b.created_us), 0).label("newest")
        query = sa.select(sa.func.count().label("many"), newest).select_from(t.shared_bundles)
        (row,) = await self._store.read(query)
        return int(row["many"]), int(row["newest"])

    async def mark_deleted(self, kind: str, name: str) -> None:
        """Mark a bundle as deleted."""
        empty = {"content": "", "document": "", "bytes": 0, "created_us": now_us()}
        change = sa.update(t.shared_bundles).where(self._is(kind, name)).values(empty)
        await self._store.write(Write(change), *self._notice())

    async def remove(self, kind: str, name: str) -> None:
        """Remove a bundle from the list."""
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
