"""Connections to the database of a store, their errors, and the ownership of a store."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import shutil
import socket
import sqlite3
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import make_url
from sqlalchemy.exc import IntegrityError, SQLAlchemyError
from sqlalchemy.pool import StaticPool

# Errors, by remedy.

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
"""Errors of read-only, broken or missing disks, and of folders of other users."""
LITTLE_SPACE = 1 << 20
"""With fewer free bytes, a failed write is attributed to a full disk."""


class StoreError(RuntimeError):
    """The store is unusable; the message states the reason and the remedy."""


class ConflictError(StoreError):
    """A row already exists: another writer was first."""


class FencedError(StoreError):
    """Another worker has taken over the session: nothing was written."""


class StoreTroubleError(StoreError):
    """The store currently fails, and the outcome is unknown; try again later.

    Args:
        reason: text of the driver, for logs only.
    """

    told = "the worker's store is in trouble"

    def __init__(self, reason: str) -> None:
        super().__init__(self.told)
        self.reason = reason


class StoreUnavailableError(StoreTroubleError):
    """The database is unreachable, frozen or locked."""

    told = "the worker's store does not answer"


class StoreBusyError(StoreUnavailableError):
    """One statement was cancelled; the database is healthy."""

    told = "the worker's store was too busy for this"


class StoreReadOnlyError(StoreTroubleError):
    """The database is read-only; reads still succeed."""

    told = "the worker's store cannot be written to"


class StoreFullError(StoreTroubleError):
    """No space left on the database's disk."""

    told = "the worker has no space left to store anything"


def sorted_error(error: Exception, *, folder: Path | None) -> StoreError | None:
    """Convert an error of a driver; None if it is a bug.

    Args:
        error: from SQLAlchemy, a driver, or the system.
        folder: folder of a database file.
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
    """Whether the error is caused by lack of disk space."""
    return error.errno in FULL_ERRNOS


def is_refused(error: OSError) -> bool:
    """Whether the disk currently refuses writes or reads."""
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
    # For example a read-only standby server.
    (("25006",), StoreReadOnlyError),
    # Deadlocks and similar conflicts, and timeouts of locks and statements.
    (("40", "55P03", "57014"), StoreBusyError),
    # Connection, transaction state, resources, server state, operator, system.
    (("08", "25", "53", "55", "57", "58"), StoreUnavailableError),
)
"""Prefixes of a server's SQLSTATE; the first match applies."""


def _of_server(error: SQLAlchemyError, cause: BaseException) -> StoreError | None:
    if state := _sqlstate(cause):
        kinds = (kind for states, kind in _KINDS_OF_STATES if state.startswith(states))
        found = next(kinds, None)
        return found(_why(cause)) if found is not None else None
    # An error without a state is not from the server: the server is down or unreachable.
    broken = ("OperationalError", "InterfaceError", "TimeoutError", "PendingRollbackError")
    if type(error).__name__ in broken or getattr(error, "connection_invalidated", False):
        return StoreUnavailableError(_why(cause))
    return None


def _sqlstate(error: BaseException) -> str:
    """SQLSTATE of a server's error, from any driver; empty if it has none."""
    first = error.args[0] if error.args else None
    if isinstance(first, dict):
        return str(first.get("C", ""))
    return str(getattr(error, "sqlstate", None) or getattr(error, "pgcode", None) or "")


def _why(error: BaseException) -> str:
    first = error.args[0] if error.args else None
    if isinstance(first, dict):
        return str(first.get("M", first))
    return str(error) or type(error).__name__


DRIVER_TIMEOUTS = {"pg8000": "timeout", "psycopg": "connect_timeout", "psycopg2": "connect_timeout"}
"""Timeout argument of each PostgreSQL driver [s]. Only pg8000 also limits reads, which detects a
frozen server."""

RETRY_S = 0.01
"""Interval of attempts to switch the journal of an SQLite database [s]."""

SERVER_SHARE = 0.8
"""Fraction of the statement timeout after which the server cancels a statement."""


def connect(url: str, *, timeout_s: float) -> sa.Engine:
    """An engine for ``url``; for SQLite, creates the folder and uses a write-ahead journal.

    Args:
        url: SQLAlchemy URL.
        timeout_s: timeout of a statement, a lock, and a server's answer [s].
    """
    parsed = make_url(url)
    if parsed.get_backend_name() != "sqlite":
        return _server_engine(parsed, timeout_s)
    file = file_of(url)
    if file is None:
        # An in-memory database belongs to its connection; all threads share it.
        other_threads = {"check_same_thread": False}
        engine = sa.create_engine(parsed, poolclass=StaticPool, connect_args=other_threads)
    else:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        make_private(file)
        engine = sa.create_engine(parsed, connect_args={"timeout": timeout_s})

    @sa.event.listens_for(engine, "connect")
    def set_up(connection: Any, _record: object) -> None:
        cursor = connection.cursor()
        if not cursor.execute("PRAGMA page_count").fetchone()[0]:
            # Incremental vacuum must be enabled before the first table is created.
            cursor.execute("PRAGMA auto_vacuum=INCREMENTAL")
        keep_write_ahead_journal(cursor, timeout_s)
        # Keep the rollback data of statements in memory.
        for pragma in ("synchronous=NORMAL", "foreign_keys=ON", "temp_store=MEMORY"):
            cursor.execute(f"PRAGMA {pragma}")
        cursor.execute(f"PRAGMA busy_timeout={round(timeout_s * 1000)}")
        cursor.close()

    return engine


def keep_write_ahead_journal(cursor: sqlite3.Cursor, timeout_s: float) -> None:
    """Switch a database to a write-ahead journal.

    If several connections switch the journal of one file at the same time, SQLite refuses all but
    one without waiting, so this function retries.

    Raises:
        sqlite3.OperationalError: the file stays locked for ``timeout_s``, or is unusable.
    """
    last = time.monotonic() + timeout_s
    while True:
        try:
            cursor.execute("PRAGMA journal_mode=WAL")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > last:
                raise
            time.sleep(RETRY_S)


def _server_engine(url: sa.URL, timeout_s: float) -> sa.Engine:
    limit = DRIVER_TIMEOUTS.get(url.get_driver_name())
    # The other drivers require whole seconds.
    seconds = timeout_s if limit == "timeout" else max(1, round(timeout_s))
    arguments = {limit: seconds} if limit else {}
    engine = sa.create_engine(
        url, pool_pre_ping=True, pool_timeout=timeout_s, connect_args=arguments
    )
    if url.get_driver_name() == "pg8000":
        sa.event.listen(engine, "do_connect", _connect_by_own_socket)
    if url.get_backend_name() == "postgresql":

        @sa.event.listens_for(engine, "connect")
        def set_up(connection: Any, _record: object) -> None:
            cursor = connection.cursor()
            for name in ("statement_timeout", "lock_timeout"):
                cursor.execute(f"SET {name} = {round(timeout_s * SERVER_SHARE * 1000)}")
            cursor.close()
            connection.commit()

    return engine


def native_connection(url: sa.URL, timeout_s: float) -> tuple[Any, socket.socket]:
    """A native pg8000 connection outside of all pools, and its socket; each statement is
    committed separately.

    Raises:
        pg8000.exceptions.Error: the server is unreachable, or refuses.
    """
    from pg8000 import native

    engine_dialect = url.get_dialect()()
    _, parameters = engine_dialect.create_connect_args(url)
    address = parameters.get("host", "localhost"), parameters.get("port", 5432)
    try:
        connected = socket.create_connection(address, timeout_s)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    except OSError as error:
        raise native.InterfaceError(
            f"no connection to {address[0]}:{address[1]}: {error}"
        ) from error
    try:
        connection = native.Connection(**parameters, timeout=timeout_s, sock=connected)
        for name in ("statement_timeout", "lock_timeout"):
            connection.run(f"SET {name} = {round(timeout_s * SERVER_SHARE * 1000)}")
    except BaseException:
        connected.close()
        raise
    return connection, connected


def _connect_by_own_socket(
    dialect: Any, _record: object, arguments: list[Any], parameters: dict[str, Any]
) -> Any:
    """A pg8000 connection; closes its socket if connecting fails. pg8000 leaves it open if a server
    accepts connections but does not answer."""
    if {"sock", "unix_sock", "source_address"} & parameters.keys():
        return None  # the driver connects itself
    address = parameters.get("host", "localhost"), parameters.get("port", 5432)
    try:
        connected = socket.create_connection(address, parameters.get("timeout"))
    except OSError as error:
        raise dialect.loaded_dbapi.InterfaceError(
            f"no connection to {address[0]}:{address[1]}: {error}"
        ) from error
    try:
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        # Replaces the driver's `connect`, which accepts no socket.
        return dialect.loaded_dbapi.Connection(*arguments, **parameters, sock=connected)
    except BaseException:
        connected.close()
        raise


def file_of(url: str) -> Path | None:
    """The file of an SQLite database; None for other and in-memory databases."""
    parsed = make_url(url)
    if parsed.get_backend_name() != "sqlite" or not parsed.database:
        return None
    return None if parsed.database == ":memory:" else Path(parsed.database).absolute()


def make_private(file: Path) -> None:
    """Make a database file readable only by its owner; creates it if missing.

    SQLite gives its journals the permissions of the file. An existing file is not opened:
    closing it would release all locks of this process on it (fcntl(2)), and another process could
    then remove the journal that its connections still use.
    """
    with contextlib.suppress(FileExistsError):
        os.close(os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
    for path in (file, *(file.with_name(file.name + end) for end in ("-wal", "-shm"))):
        if path.exists() and path.stat().st_mode & 0o077:
            path.chmod(0o600)


def shown_url(url: str) -> str:
    """The URL without its password."""
    try:
        return make_url(url).render_as_string(hide_password=True)
    except sa.exc.ArgumentError:
        return "<no SQLAlchemy URL>"


# --- Ownership of a state folder -----------------------------------------------------------------

LOCK_FILE = "worker.lock"


class StateFolderError(OSError):
    """The state folder is unusable; the message states the reason and the remedy."""


def check_state_folder(folder: Path) -> None:
    """Check that the state folder is usable. Raises StateFolderError."""
    with owned_folder(folder):
        pass


@contextlib.contextmanager
def owned_folder(folder: Path) -> Iterator[None]:
    """Lock the state folder during the block; creates it if missing.

    The kernel releases the lock when the process ends for any reason; the file stays.

    Raises:
        StateFolderError: another process owns it (the message has its PID), or it is not writable.
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
    """Ensure during the block that only this worker uses a name on a database file.

    Workers with separate state folders and names may share one database.

    Raises:
        StateFolderError: another process uses the name (the message has its PID).
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
            f"the state folder {str(place)!r} is in use by another worker ({owner}). Stop it, "
            "or give this worker another folder with --data or REAL2SIM_DATA_DIR"
        )
    return StateFolderError(
        f"a worker {name!r} already runs on the store {str(place)!r} ({owner}). Stop it, or give "
        "this worker another name with REAL2SIM_WORKER_ID"
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


# --- Ownership of a name on a server -------------------------------------------------------------

NAME_SPACE = 0x5232_5302
"""Class of PostgreSQL's advisory locks for worker names."""


class NameOnServer:
    """Ensures that only one worker uses a name on a PostgreSQL database.

    The lock belongs to a dedicated connection, and ends with it.
    """

    def __init__(self, engine: sa.Engine, worker_id: str) -> None:
        self._engine = engine
        self._worker_id = worker_id
        self._connection: sa.Connection | None = None

    def hold(self) -> None:
        """Take the name, or check that this process still has it.

        Raises:
            StoreError: another worker has it.
            sqlalchemy.exc.SQLAlchemyError: the server does not answer.
        """
        if self._connection is None:
            self._take()
            return
        try:
            self._connection.exec_driver_sql("SELECT 1")
        except Exception:
            # Drivers do not convert socket errors; any of them breaks the connection.
            self.drop()
            raise

    def drop(self) -> None:
        """Release the name."""
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(sa.exc.SQLAlchemyError, OSError):
                connection.invalidate()
                connection.close()

    def _take(self) -> None:
        engine = self._engine.execution_options(isolation_level="AUTOCOMMIT")
        connection = engine.connect()
        try:
            who = f"real2sim {self._worker_id}, process {os.getpid()} on {socket.gethostname()}"
            name = {"who": who[:63], "name": f"real2sim worker {self._worker_id}"}
            connection.execute(sa.text("SELECT set_config('application_name', :who, false)"), name)
            taken = "SELECT pg_try_advisory_lock(:space, hashtext(:name))"
            if not connection.execute(sa.text(taken), name | {"space": NAME_SPACE}).scalar():
                raise StoreError(self._told(connection, name))
        except BaseException:
            connection.close()
            raise
        self._connection = connection

    def _told(self, connection: sa.Connection, name: dict[str, str]) -> str:
        owner = connection.execute(
            sa.text(
                "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid) "
                "WHERE l.locktype = 'advisory' AND l.classid::bigint = :space "
                "AND l.objid::bigint = (hashtext(:name)::bigint & 4294967295) LIMIT 1"
            ),
            name | {"space": NAME_SPACE},
        ).scalar()
        return (
            f"a worker {self._worker_id!r} already runs on this store ({owner or 'unknown'}). Stop "
            "it, or give this worker another name with REAL2SIM_WORKER_ID"
        )


# --- Prepared statements -------------------------------------------------------------------------

# Each statement is one round trip to PostgreSQL and its own transaction. SQLAlchemy begins and ends
# a transaction around each and parses it again, which takes several times the processor time.


@dataclass(frozen=True, eq=False)
class Prepared:
    """A statement for :class:`PreparedStatements`.

    Attributes:
        text: SQL with ``:name`` for values; returns one row per changed row.
        values: values by name.
    """

    text: str
    values: Mapping[str, object]


class PreparedStatements:
    """Statements that are prepared once per connection. Not thread-safe.

    Args:
        url: URL of the database, with the driver pg8000.
        timeout_s: timeout of a statement, a lock, an answer [s].
    """

    def __init__(self, url: sa.URL, *, timeout_s: float) -> None:
        self._url = url
        self._timeout_s = timeout_s
        self._connection: Any = None
        self._socket: socket.socket | None = None
        self._known: dict[str, Any] = {}

    def execute(self, prepared: Prepared) -> int:
        """Execute and commit the statement; returns the number of changed rows.

        Raises:
            sqlalchemy.exc.SQLAlchemyError: the server reports an error or is unreachable.
        """
        if self._is_broken():
            self.close()
        try:
            statement = self._statement(prepared.text)
            return len(statement.run(**prepared.values))
        except Exception as error:
            self._sort(error, prepared.text)
            raise

    def close(self) -> None:
        """Disconnect; the next statement reconnects."""
        connection, self._connection = self._connection, None
        self._known.clear()
        if connection is not None:
            with contextlib.suppress(Exception):
                connection.close()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _statement(self, text: str) -> Any:
        if self._connection is None:
            self._connection, self._socket = native_connection(self._url, self._timeout_s)
        if (known := self._known.get(text)) is None:
            known = self._known[text] = self._connection.prepare(text)
        return known

    def _is_broken(self) -> bool:
        """Whether the server has sent unexpected data, most likely a notice that it closes the
        connection."""
        return self._socket is not None and bool(select.select([self._socket], [], [], 0)[0])

    def _sort(self, error: Exception, text: str) -> None:
        """Raise errors of the driver like SQLAlchemy; closes a connection that may be broken."""
        from pg8000.exceptions import DatabaseError, InterfaceError

        state = str(error.args[0].get("C", "")) if _is_of_server(error) else ""
        if not state.startswith("23"):
            self.close()
        if isinstance(error, DatabaseError):
            raise sa.exc.OperationalError(text, None, error) from error
        if isinstance(error, InterfaceError):
            raise sa.exc.InterfaceError(text, None, error) from error


def _is_of_server(error: Exception) -> bool:
    return bool(error.args) and isinstance(error.args[0], dict)
