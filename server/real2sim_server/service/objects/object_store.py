"""Where objects lie: files without names, found by the SHA-256 of what is in them.

An object never changes, so that whoever has its digest has it right, and putting it twice is
putting it once. A store is slow and may be gone: everything here waits, and belongs on threads that
nobody else waits for.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Protocol
from urllib.parse import parse_qsl, unquote, urlsplit

from ..._files import atomic_file

if TYPE_CHECKING:
    from obstore.store import S3Store

DIGEST = re.compile(r"[0-9a-f]{64}")
FRESH_S = 12 * 3600.0
"""Age from which on an object that is put again is written again, so that it looks young."""
RETRIES = 3
"""Of a request that a store has not answered, or has refused for being busy."""
PIECE_BYTES = 4 << 20
"""That is read from a store at a time."""


class ObjectStoreError(Exception):
    """The store of objects cannot be used, or does not have the object; nothing has happened."""


@dataclass(frozen=True)
class StoredObject:
    """An object in a store.

    Attributes:
        digest: SHA-256 of its content, hexadecimal.
        bytes: size.
        age_s: since it was last put [s].
    """

    digest: str
    bytes: int
    age_s: float


class ObjectStore(Protocol):
    """A store of objects; safe to use on any thread, never on the event loop.

    Every method raises :class:`ObjectStoreError` where the store cannot be used.
    """

    def put(self, file: Path, digest: str) -> None:
        """Keep the content of a file whose digest is known."""

    def read(self, digest: str, start: int, end: int) -> bytes:
        """Bytes ``start`` to ``end`` of an object, the last excluded."""

    def find(self, digest: str) -> StoredObject | None:
        """What the store knows of an object; None where it has none."""

    def signed_url(self, digest: str, seconds: float) -> str | None:
        """Where anybody may fetch the object for a while; None where that cannot be had."""

    def list(self) -> Iterator[StoredObject]:
        """All objects, in any order."""

    def remove(self, digest: str) -> None:
        """Forget an object; nothing where there is none."""


def open_objects(url: str) -> ObjectStore:
    """The store that a URL names.

    Args:
        url: ``file:///shared/objects``, or ``s3://bucket/prefix`` with ``endpoint`` and ``region``
            as a query where it is not AWS itself; keys come from ``AWS_ACCESS_KEY_ID`` and
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
        f"{url!r} is no store of objects: give file:///folder, or "
        "s3://bucket/prefix?endpoint=https://host&region=name"
    )


class FolderObjects:
    """Objects as files of a folder, which workers on one machine or one file system share.

    Args:
        folder: of the objects; it is made with the first.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, file: Path, digest: str) -> None:
        """Keep the content of a file."""
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
        """What is known of an object."""
        path = self._path(digest)
        try:
            found = path.stat()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unusable(error) from error
        return StoredObject(digest, found.st_size, time.time() - found.st_mtime)

    def signed_url(self, digest: str, seconds: float) -> str | None:
        """None: nobody but workers reaches the folder."""
        return None

    def list(self) -> Iterator[StoredObject]:
        """All objects."""
        for path in self._folder.glob("??/*"):
            if DIGEST.fullmatch(path.name) and (found := self.find(path.name)) is not None:
                yield found

    def remove(self, digest: str) -> None:
        """Forget an object."""
        try:
            self._path(digest).unlink(missing_ok=True)
        except OSError as error:
            raise _unusable(error) from error

    def _path(self, digest: str) -> Path:
        return self._folder / digest[:2] / _checked(digest)


class S3Objects:
    """Objects in a bucket of S3, or of anything that speaks its protocol.

    Args:
        bucket: its name.
        prefix: of the objects' names.
        endpoint: where it is served; AWS by default.
        region: of the bucket.

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
        """Keep the content of a file."""
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
        """What is known of an object."""
        import obstore

        try:
            with _refusals():
                found = obstore.head(self._store, _key(digest))
        except FileNotFoundError:
            return None
        return _stored(found)

    def signed_url(self, digest: str, seconds: float) -> str | None:
        """Where anybody may fetch it for a while."""
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
        """Forget an object."""
        import obstore

        with _refusals():
            obstore.delete(self._store, _key(digest))


class _refusals:
    """Errors of the client as this module has them; that there is no such object stays as it is."""

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
        raise ValueError(f"{digest!r} is no SHA-256 in lower case")
    return digest


def _unusable(error: OSError) -> ObjectStoreError:
    return ObjectStoreError(f"the folder of objects: {error.strerror or error}")
