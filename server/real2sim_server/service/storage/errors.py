"""What can go wrong with a store, sorted by what there is to do about it."""

from __future__ import annotations

import errno
import shutil
import sqlite3
from pathlib import Path

from sqlalchemy.exc import IntegrityError, SQLAlchemyError

FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
REFUSED_ERRNOS = frozenset(
    {
        errno.EROFS,
        errno.EIO,
        errno.EACCES,
        errno.EPERM,
        errno.ESTALE,
        errno.ENODEV,
        errno.ENXIO,
        errno.ENOTCONN,
    }
)
"""Of a disk that is read-only, broken or gone, and of folders that belong to others."""
LITTLE_SPACE = 1 << 20
"""Free bytes below which a failed write is put down to a full disk."""


class StoreError(RuntimeError):
    """The store cannot be used; the message says why and what to do."""


class ConflictError(StoreError):
    """A row that must be new exists already: another writer was first."""


class FencedError(StoreError):
    """The session belongs to another worker by now: nothing was written."""


class StoreTroubleError(StoreError):
    """The store cannot do it just now, and whether it was done is open; send it again later.

    Args:
        reason: in the words of the driver, for the log and not for clients.
    """

    told = "the worker's store is in trouble"

    def __init__(self, reason: str) -> None:
        super().__init__(self.told)
        self.reason = reason


class StoreUnavailableError(StoreTroubleError):
    """The database is gone, frozen or locked."""

    told = "the worker's store does not answer"


class StoreBusyError(StoreUnavailableError):
    """One statement was given up; the database is well."""

    told = "the worker's store was too busy for this"


class StoreReadOnlyError(StoreTroubleError):
    """The database is there and takes nothing; reading goes on."""

    told = "the worker's store cannot be written to"


class StoreFullError(StoreTroubleError):
    """There is no space left where the database is."""

    told = "the worker has no space left to store anything"


def sorted_error(error: Exception, *, folder: Path | None) -> StoreError | None:
    """The error of a driver as one of ours; None where it is a bug.

    Args:
        error: of SQLAlchemy, of a driver, or of the system.
        folder: of a database that is a file.
    """
    if isinstance(error, StoreError):
        return error
    cause = getattr(error, "orig", None) or error
    refused = isinstance(error, IntegrityError) or isinstance(cause, sqlite3.IntegrityError)
    if refused or _sqlstate(cause).startswith("23"):
        return ConflictError(f"not stored: {cause}")
    if isinstance(cause, OSError):
        return StoreFullError(_why(cause)) if is_full(cause) else StoreUnavailableError(_why(cause))
    if isinstance(cause, sqlite3.Error):
        return _of_sqlite(cause, folder)
    if isinstance(error, SQLAlchemyError):
        return _of_server(error, cause)
    return None


def is_full(error: OSError) -> bool:
    """Whether it is for want of space that a file was not written."""
    return error.errno in FULL_ERRNOS


def is_refused(error: OSError) -> bool:
    """Whether the disk takes nothing at present, or gives nothing."""
    return error.errno in REFUSED_ERRNOS


def _of_sqlite(error: sqlite3.Error, folder: Path | None) -> StoreError | None:
    code = getattr(error, "sqlite_errorcode", None)
    if code is None:
        return None
    if code in _REFUSED_WRITES or code & 0xFF == sqlite3.SQLITE_READONLY:
        full = folder is not None and _has_little_space(folder)
        return StoreFullError(_why(error)) if full else StoreReadOnlyError(_why(error))
    match code & 0xFF:
        case sqlite3.SQLITE_FULL:
            return StoreFullError(_why(error))
        case sqlite3.SQLITE_IOERR | sqlite3.SQLITE_CANTOPEN:
            full = folder is not None and _has_little_space(folder)
            return StoreFullError(_why(error)) if full else StoreUnavailableError(_why(error))
        case (
            sqlite3.SQLITE_BUSY
            | sqlite3.SQLITE_LOCKED
            | sqlite3.SQLITE_PERM
            | sqlite3.SQLITE_PROTOCOL
            | sqlite3.SQLITE_CORRUPT
            | sqlite3.SQLITE_NOTADB
        ):
            return StoreUnavailableError(_why(error))
    return None


_REFUSED_WRITES = frozenset(
    {
        sqlite3.SQLITE_IOERR_WRITE,
        sqlite3.SQLITE_IOERR_FSYNC,
        sqlite3.SQLITE_IOERR_DIR_FSYNC,
        sqlite3.SQLITE_IOERR_TRUNCATE,
        sqlite3.SQLITE_IOERR_DELETE,
    }
)


def _has_little_space(folder: Path) -> bool:
    try:
        return shutil.disk_usage(folder).free < LITTLE_SPACE
    except OSError:
        return False


_KINDS_OF_STATES: tuple[tuple[tuple[str, ...], type[StoreTroubleError]], ...] = (
    (("53100",), StoreFullError),
    # Of a server that follows another one, for example.
    (("25006",), StoreReadOnlyError),
    # Deadlocks and the like, locks and statements that took too long.
    (("40", "55P03", "57014"), StoreBusyError),
    # Connection, transaction state, resources, state of the server, operator, system.
    (("08", "25", "53", "55", "57", "58"), StoreUnavailableError),
)
"""Beginnings of states of a server's errors; the first that fits counts."""


def _of_server(error: SQLAlchemyError, cause: BaseException) -> StoreError | None:
    if state := _sqlstate(cause):
        kinds = (kind for states, kind in _KINDS_OF_STATES if state.startswith(states))
        found = next(kinds, None)
        return found(_why(cause)) if found is not None else None
    # Without a state the server has not spoken: it is not there, or the way to it is broken.
    broken = ("OperationalError", "InterfaceError", "TimeoutError", "PendingRollbackError")
    if type(error).__name__ in broken or getattr(error, "connection_invalidated", False):
        return StoreUnavailableError(_why(cause))
    return None


def _sqlstate(error: BaseException) -> str:
    """Of a server's error, in whatever words of the driver; empty where there is none."""
    first = error.args[0] if error.args else None
    if isinstance(first, dict):
        return str(first.get("C", ""))
    return str(getattr(error, "sqlstate", None) or getattr(error, "pgcode", None) or "")


def _why(error: BaseException) -> str:
    first = error.args[0] if error.args else None
    if isinstance(first, dict):
        return str(first.get("M", first))
    return str(error) or type(error).__name__
