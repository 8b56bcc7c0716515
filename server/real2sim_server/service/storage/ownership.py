"""Who owns a state folder, or a name on a database file: one process, as long as it lives."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

LOCK_FILE = "worker.lock"


class StateFolderError(OSError):
    """The state folder cannot be used; the message says why and what to do."""


def check_state_folder(folder: Path) -> None:
    """Refuse a state folder that cannot be used now. Raises StateFolderError."""
    with owned_folder(folder):
        pass


@contextlib.contextmanager
def owned_folder(folder: Path) -> Iterator[None]:
    """Own the state folder for the length of the block; made where it is missing.

    The lock is the kernel's, so that it ends with the process however that ends; the file stays.

    Raises:
        StateFolderError: another process owns it, named by its PID; or it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = _open_private(folder / LOCK_FILE)
    except OSError as error:
        raise _unusable(folder, error) from error
    try:
        _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def owned_name(database: Path, worker_id: str) -> Iterator[None]:
    """Be the only worker of that name on a database file, for the length of the block.

    Workers with state folders and names of their own may share one database.

    Raises:
        StateFolderError: another process has the name, named by its PID.
    """
    path = database.with_name(f"{database.name}.{worker_id}.lock")
    try:
        descriptor = _open_private(path)
    except OSError as error:
        raise _unusable(path.parent, error) from error
    try:
        _lock(descriptor, database, name=worker_id)
        yield
    finally:
        os.close(descriptor)


def _open_private(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)


def _lock(descriptor: int, place: Path, *, name: str | None = None) -> None:
    if sys.platform == "win32":
        return
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        owner = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip()
        raise _taken(place, owner or "process unknown", name) from error
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):
            raise _unusable(place, error) from error
        raise StateFolderError(
            f"the file system of {str(place)!r} has no locks, so that two workers could write "
            "there at once: give a folder on a local disk with --data or REAL2SIM_DATA_DIR"
        ) from error
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
    except OSError as error:
        raise _unusable(place, error) from error


def _taken(place: Path, owner: str, name: str | None) -> StateFolderError:
    if name is None:
        return StateFolderError(
            f"the state folder {str(place)!r} is in use by another worker ({owner}). Stop that "
            "one, or give this one a folder of its own with --data or REAL2SIM_DATA_DIR"
        )
    return StateFolderError(
        f"a worker {name!r} runs on the store {str(place)!r} already ({owner}). Stop that one, or "
        "give this one another name with REAL2SIM_WORKER_ID"
    )


def _unusable(folder: Path, error: OSError) -> StateFolderError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        remedy = "free some space there"
    else:
        remedy = (
            f"make it writable for user {os.getuid() if hasattr(os, 'getuid') else 'of the worker'}"
        )
    return StateFolderError(
        f"the state folder {str(folder)!r} cannot be written to: {error.strerror or error}. "
        f"{remedy.capitalize()}, or give another one with --data or REAL2SIM_DATA_DIR"
    )
