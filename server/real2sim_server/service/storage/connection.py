"""How the database of a store is reached: drivers, time limits, journals, private files."""

from __future__ import annotations

import contextlib
import os
import socket
import sqlite3
import time
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import make_url
from sqlalchemy.pool import StaticPool

DRIVER_TIMEOUTS = {"pg8000": "timeout", "psycopg": "connect_timeout", "psycopg2": "connect_timeout"}
"""Argument of a PostgreSQL driver that limits its waiting [s]. Only pg8000 limits reading too, so
that a server that is frozen is noticed."""

RETRY_S = 0.01
"""Between two attempts to change the journal of an SQLite database [s]."""

SERVER_SHARE = 0.8
"""Of the time that a statement may take, before the server itself gives it up."""


def connect(url: str, *, timeout_s: float) -> sa.Engine:
    """An engine for ``url``; SQLite's folder is made, its journal is a write-ahead one.

    Args:
        url: SQLAlchemy URL.
        timeout_s: of one statement, of a lock, and of an answer of the server [s].
    """
    parsed = make_url(url)
    if parsed.get_backend_name() != "sqlite":
        return _server_engine(parsed, timeout_s)
    file = file_of(url)
    if file is None:
        # Such a database belongs to its connection, whichever thread uses it.
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
            # Freed pages can be given back in pieces, if this is said before there is any.
            cursor.execute("PRAGMA auto_vacuum=INCREMENTAL")
        keep_write_ahead_journal(cursor, timeout_s)
        # What is needed to take back one of several rows has no need of a file.
        for pragma in ("synchronous=NORMAL", "foreign_keys=ON", "temp_store=MEMORY"):
            cursor.execute(f"PRAGMA {pragma}")
        cursor.execute(f"PRAGMA busy_timeout={round(timeout_s * 1000)}")
        cursor.close()

    return engine


def keep_write_ahead_journal(cursor: sqlite3.Cursor, timeout_s: float) -> None:
    """Let a database keep a write-ahead journal.

    Of several connections that change the journal of one file at once, SQLite refuses all but one
    without letting them wait; so they try again here.

    Raises:
        sqlite3.OperationalError: the file stays locked for ``timeout_s``, or cannot be used.
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
    # The others take whole seconds.
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
    """A connection of pg8000's own kind, outside of all pools, and its socket; each statement is
    committed by itself.

    Raises:
        pg8000.exceptions.Error: there is no server, or it refuses.
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
    """A connection of pg8000, whose socket is closed at once where none comes of it: pg8000 leaves
    it open where a server takes connections and answers nothing."""
    if {"sock", "unix_sock", "source_address"} & parameters.keys():
        return None  # by the driver itself
    address = parameters.get("host", "localhost"), parameters.get("port", 5432)
    try:
        connected = socket.create_connection(address, parameters.get("timeout"))
    except OSError as error:
        raise dialect.loaded_dbapi.InterfaceError(
            f"no connection to {address[0]}:{address[1]}: {error}"
        ) from error
    try:
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        # What `connect` of the driver does, which takes no socket.
        return dialect.loaded_dbapi.Connection(*arguments, **parameters, sock=connected)
    except BaseException:
        connected.close()
        raise


def file_of(url: str) -> Path | None:
    """The file of an SQLite database; None for others and for those in memory."""
    parsed = make_url(url)
    if parsed.get_backend_name() != "sqlite" or not parsed.database:
        return None
    return None if parsed.database == ":memory:" else Path(parsed.database).absolute()


def make_private(file: Path) -> None:
    """Make sure that nobody but its owner can read a database file; made where it is missing.

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
