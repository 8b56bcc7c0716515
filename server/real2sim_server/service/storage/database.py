"""The database of a store: statements on a thread of its own, what reaches the disk, and trouble.

It knows no tables but the one that shows whether it is well; what is asked is the store's.
"""

from __future__ import annotations

import asyncio
import contextlib
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar, cast

import sqlalchemy as sa
import structlog

from . import schema as t
from .connection import (
    FencedError,
    NameOnServer,
    Prepared,
    PreparedStatements,
    StateFolderError,
    StoreBusyError,
    StoreError,
    StoreFullError,
    StoreTroubleError,
    StoreUnavailableError,
    connect,
    file_of,
    owned_name,
    shown_url,
    sorted_error,
)
from .schema import Policy, prepare_schema

T = TypeVar("T")

TIMEOUT_S = 5.0
PATIENCE = 3.0
"""Timeouts that a caller waits for its turn and its answer."""
PROBE_S = 1.0
"""Between questions whether a store in trouble is well again."""
CHECK_S = 5.0
"""Between questions whether a store is still well."""
SCHEMA_TIMEOUT_S = 3600.0
"""Of a migration: it may have to rewrite everything."""

Durability = Literal["all", "edits", "process"]
"""What is on the disk before it is acknowledged: all, all but steps of sessions, or nothing; what
is not is safe when the process dies, and the last of it lost when the machine does."""

OnCall = Callable[[str, float, bool], None]
"""Told of a call: ``read`` or ``write``, its seconds, and whether it went well."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True, eq=False)
class Write:
    """A statement that writes. Rows beside it, not in it, so that it is compiled only once.

    Attributes:
        statement: as text it goes to the driver as it is, with tuples as rows.
        rows: that it is made with, once for each.
        prepared: the same for a connection that prepares it, where it may be alone in its
            transaction.
        fenced: how many rows it must change; fewer mean that their sessions were taken over, and
            nothing of the transaction is kept. None where it may be any number.
    """

    statement: sa.Executable | str
    rows: list[dict[str, Any]] | list[tuple[Any, ...]] | None = None
    fenced: int | None = None
    prepared: Prepared | None = None

    def made_by(self, connection: sa.Connection) -> sa.CursorResult[Any]:
        """What comes of it."""
        if isinstance(self.statement, str):
            return connection.exec_driver_sql(self.statement, cast("Any", self.rows))
        return connection.execute(self.statement, cast("Any", self.rows))

    def checked(self, changed: int) -> int:
        """The rows that it changed. Raises FencedError."""
        if self.fenced is not None and changed != self.fenced:
            raise FencedError("another worker has taken the session over")
        return changed


class Database:
    """SQLAlchemy Core on one thread of its own, so that the event loop never waits for a disk.

    A database in trouble is noticed within ``timeout_s``. From then on calls are refused at once,
    until a probe of :meth:`watch` finds it well again.

    One thread is enough: an append takes 0.1 to 0.2 ms in SQLite's write-ahead mode, which has
    one writer at a time anyway, and the order of appends is the order of the calls. Code that
    computes on another thread may write from there, by :meth:`execute`: to be woken by a thread
    and to wake another one takes longer than an append.

    Args:
        url: SQLAlchemy URL; ``sqlite:///path`` or, with its driver installed, ``postgresql://``.
        worker_id: name to hold as long as the database is open; None for a guest.
        timeout_s: of a statement, a lock, an answer [s].
        durability: what reaches the disk before it is acknowledged.
        migration: whether a store of an older schema is brought up to date.
        on_call: told of each read and write, on the thread that did it.
    """

    def __init__(
        self,
        url: str,
        *,
        worker_id: str | None = None,
        timeout_s: float = TIMEOUT_S,
        durability: Durability = "edits",
        migration: Policy = "auto",
        on_call: OnCall | None = None,
    ) -> None:
        self.url = url
        self._on_call = on_call
        self._worker_id = worker_id
        self._timeout_s = timeout_s
        self._durability = durability
        self._migration: Policy = migration
        self._trouble: StoreTroubleError | None = None
        self._trouble_since = 0.0
        self._file: Path | None = None
        self._name_on_server: NameOnServer | None = None
        self._owned = contextlib.ExitStack()
        self._writer_is_durable = False
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="store")
        self._write_lock = threading.Lock()
        self._engine: sa.Engine | None = None
        self._writer: sa.Connection | None = None
        self._prepared: PreparedStatements | None = None

    async def open(self, first: Write) -> None:
        """Connect, create what is missing, and execute the first statement.

        Raises:
            StoreError: the database cannot be opened, or is of a newer version.
            StateFolderError: another worker of that name is on it.
        """
        await self._run(partial(self._open, first))

    async def close(self) -> None:
        """Finish what was begun and disconnect."""
        await self._run(self._close)
        self._executor.shutdown()

    @property
    def trouble(self) -> StoreTroubleError | None:
        """What is wrong with the database; None while it is well."""
        return self._trouble

    @property
    def is_server(self) -> bool:
        """Whether it is a server, which has a clock of its own and many writers."""
        return self._connected().dialect.name == "postgresql"

    @property
    def is_file(self) -> bool:
        """Whether it is a file of SQLite's."""
        return self._file is not None

    async def watch(self) -> None:
        """Look after the database for ever: notice trouble, and its end."""
        while True:
            await asyncio.sleep(PROBE_S if self._trouble else CHECK_S)
            try:
                await self.on_thread(self._probe)
            except StoreError:
                continue
            except Exception:
                # Whatever it was: without this watch the store would never be well again.
                log.exception("looking after the store failed")

    # --- statements -------------------------------------------------------------------------

    async def read(self, query: sa.Select[Any]) -> list[dict[str, Any]]:
        """Rows of a query."""

        def read() -> list[dict[str, Any]]:
            self._refuse_while_down()
            try:
                with self._timed("read"), self._connected().connect() as connection:
                    return [dict(row) for row in connection.execute(query).mappings()]
            except Exception as error:
                self._reraise(error)

        self._refuse_while_down()
        return await self.on_thread(read)

    async def write(self, *changes: Write) -> list[int]:
        """Rows changed by each statement, in one transaction; the answer is a promise.

        Raises:
            ConflictError: a row that must be new exists.
            FencedError: a session was taken over.
        """
        self._refuse_while_down()
        return await self.on_thread(partial(self.execute, changes))

    async def write_returning(self, statement: sa.UpdateBase) -> list[dict[str, Any]]:
        """Rows that a statement returns which writes, in a transaction of its own."""

        def write() -> list[dict[str, Any]]:
            self._refuse_while_down()
            try:
                with (
                    self._timed("write"),
                    self._write_lock,
                    self._transaction(durable=True) as connection,
                ):
                    return [dict(row) for row in connection.execute(statement).mappings()]
            except Exception as error:
                self._reraise(error)

        self._refuse_while_down()
        return await self.on_thread(write)

    def execute(self, changes: Sequence[Write], *, promised: bool = True) -> list[int]:
        """Like :meth:`write`, on the calling thread; never on the event loop.

        Args:
            changes: all of them, or none.
            promised: whether somebody relies on them beyond a session: then they are on the disk
                before this returns, unless ``durability`` is ``process``.
        """
        self._refuse_while_down()
        durable = self._durability == "all" or (promised and self._durability == "edits")
        # SQLite lets those who find it locked sleep and try again; they had better queue here.
        if not self._write_lock.acquire(timeout=self._timeout_s):
            raise self._noted(StoreUnavailableError("the write before this one has not ended"))
        try:
            with self._timed("write"):
                counts = self._executed(changes, durable=durable)
        except Exception as error:
            self._reraise(error)
        finally:
            self._write_lock.release()
        if self._trouble is not None:
            self._recovered()
        return counts

    async def on_thread(self, fn: Callable[[], T]) -> T:
        """``fn()`` on the thread of the database, awaited as long as any answer.

        Raises:
            StoreUnavailableError: it was not done in that time.
        """
        return await self._run(fn, patience_s=PATIENCE * self._timeout_s)

    # --- size -------------------------------------------------------------------------------

    async def used_bytes(self) -> int | None:
        """What a database of SQLite takes, without what it could give back; None for a server."""
        if self._connected().dialect.name != "sqlite":
            return None
        return await self.on_thread(self._pages_bytes)

    async def give_back(self, pages: int) -> bool:
        """Give free pages of a database file back to the disk; whether there are more."""
        if self._file is None:
            return False
        return await self.on_thread(partial(self._shrink, pages))

    def _pages_bytes(self) -> int:
        with self._connected().connect() as connection:
            count, free, size = (
                connection.exec_driver_sql(f"PRAGMA {name}").scalar_one()
                for name in ("page_count", "freelist_count", "page_size")
            )
        return int((count - free) * size)

    def _shrink(self, pages: int) -> bool:
        try:
            with self._write_lock, self._connected().connect() as connection:
                cursor = _driver_of(connection).cursor()
                (before,) = cursor.execute("PRAGMA freelist_count").fetchone()
                # A step a page; the driver makes but one of what has no columns, save in scripts.
                cursor.executescript(f"PRAGMA incremental_vacuum({pages})")
                (after,) = cursor.execute("PRAGMA freelist_count").fetchone()
                more = 0 < after < before
                if not more:
                    cursor.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
                cursor.close()
                return bool(more)
        except Exception as error:
            self._reraise(error)

    # --- inside -----------------------------------------------------------------------------

    async def _run(self, fn: Callable[[], T], *, patience_s: float | None = None) -> T:
        """``fn()`` on the database's thread; done also when the caller is cancelled or has left.

        Raises:
            StoreUnavailableError: it was not done within ``patience_s``.
        """
        work = asyncio.get_running_loop().run_in_executor(self._executor, fn)
        work.add_done_callback(_looked_at)
        done, _ = await asyncio.wait((work,), timeout=patience_s)
        if not done:
            raise self._noted(StoreUnavailableError(f"no answer within {patience_s:g} s"))
        return work.result()

    @contextlib.contextmanager
    def _timed(self, kind: str) -> Iterator[None]:
        started, done = time.perf_counter(), False
        try:
            yield
            done = True
        finally:
            if self._on_call is not None:
                self._on_call(kind, time.perf_counter() - started, done)

    def _executed(self, changes: Sequence[Write], *, durable: bool) -> list[int]:
        """Rows changed by each statement, in one transaction; the caller holds the write lock."""
        if self._file is not None and len(changes) == 1 and isinstance(changes[0].statement, str):
            return [self._executed_by_driver(changes[0], durable=durable)]
        if self._prepared is not None and len(changes) == 1 and changes[0].prepared is not None:
            return [changes[0].checked(self._prepared.execute(changes[0].prepared))]
        with self._transaction(durable=durable) as connection:
            return [c.checked(c.made_by(connection).rowcount) for c in changes]

    def _executed_by_driver(self, change: Write, *, durable: bool) -> int:
        """The same of one statement as text, for a file: SQLAlchemy would take longer to hand it
        on than SQLite to append what a step leaves."""
        statement, rows = cast("str", change.statement), change.rows or [()]
        with self._kept_writer(durable=durable) as writer:
            connection = _driver_of(writer)
            # The driver begins a transaction by itself; it is rolled back where one row fails.
            with connection:
                if len(rows) == 1:
                    cursor = connection.execute(statement, cast("Any", rows[0]))
                else:
                    cursor = connection.executemany(statement, cast("Any", rows))
                return change.checked(cursor.rowcount)

    @contextlib.contextmanager
    def _transaction(self, *, durable: bool) -> Iterator[sa.Connection]:
        """A transaction of its own, committed at the end; the caller holds the write lock."""
        if self._file is None:
            with self._connected().begin() as connection:
                yield connection
            return
        with self._kept_writer(durable=durable) as writer, writer.begin():
            yield writer

    @contextlib.contextmanager
    def _kept_writer(self, *, durable: bool) -> Iterator[sa.Connection]:
        """The connection that writes to a file, kept unless it fails; the caller holds the write
        lock."""
        if self._writer is None:
            # Fetching a connection from the pool and giving it back takes as long as an append.
            self._writer, self._writer_is_durable = self._connected().connect(), False
        if durable != self._writer_is_durable:
            self._set_durable(self._writer, durable=durable)
        try:
            yield self._writer
        except Exception as error:
            refusals = sa.exc.IntegrityError | sqlite3.IntegrityError | FencedError
            is_refused = isinstance(error, refusals)
            if not is_refused and not self._found_full(error):
                self._drop_writer()
            raise

    def _found_full(self, error: Exception) -> bool:
        """Whether there was no space. What was written is taken back then and the connection is
        good; were it the last one and closed, readers might not get their files any more."""
        return isinstance(sorted_error(error, folder=self._folder), StoreFullError)

    @property
    def _folder(self) -> Path | None:
        return self._file.parent if self._file else None

    def _set_durable(self, writer: sa.Connection, *, durable: bool) -> None:
        # NORMAL loses no committed transaction when the process dies, only when the machine does.
        pragma = f"PRAGMA synchronous={'FULL' if durable else 'NORMAL'}"
        _driver_of(writer).execute(pragma).close()
        self._writer_is_durable = durable

    def _drop_writer(self) -> None:
        """A connection that has failed may be in any state; the next write gets another one."""
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.suppress(sa.exc.SQLAlchemyError):
                writer.invalidate()
                writer.close()

    def _connected(self) -> sa.Engine:
        if self._engine is None:
            raise StoreError("the store is not open")
        return self._engine

    # --- trouble ----------------------------------------------------------------------------

    def _refuse_while_down(self) -> None:
        trouble = self._trouble
        if isinstance(trouble, StoreUnavailableError):
            raise type(trouble)(trouble.reason)

    def _reraise(self, error: Exception) -> NoReturn:
        """Raise the error as callers get it; trouble is noted."""
        found = sorted_error(error, folder=self._folder)
        if isinstance(found, StoreTroubleError):
            self._noted(found)
        if found is None or found is error:
            raise error
        raise found from error

    def _noted(self, trouble: StoreTroubleError) -> StoreTroubleError:
        if isinstance(trouble, StoreBusyError):
            return trouble
        if self._trouble is None:
            self._trouble_since = time.monotonic()
            log.error("store in trouble", kind=type(trouble).__name__, reason=trouble.reason)
        self._trouble = trouble
        return trouble

    def _recovered(self) -> None:
        self._trouble = None
        seconds = round(time.monotonic() - self._trouble_since, 1)
        log.warning("store well again", after_s=seconds)

    def _probe(self) -> None:
        """Do what shows whether the database is well: read, and after trouble write."""
        version = t.alembic_version.c.version_num
        try:
            if self._name_on_server is not None:
                self._name_on_server.hold()
            # On a full disk connections stay good, and new ones might not get their journal.
            full = isinstance(self._trouble, StoreFullError)
            if self._trouble is not None and self._file is not None and not full:
                self._reconnect()
            with self._connected().connect() as connection:
                connection.execute(sa.select(version)).all()
            if self._trouble is None:
                return
            with self._write_lock, self._transaction(durable=True) as connection:
                connection.execute(sa.update(t.alembic_version).values(version_num=version))
        except Exception as error:
            self._reraise(error)
        self._recovered()

    def _reconnect(self) -> None:
        """Leave all connections to a file: those that were made while it could not be written to
        stay read-only for good, and SQLite makes later ones so as long as one of them is open."""
        with self._write_lock:
            self._drop_writer()
            self._connected().dispose()

    # --- opening ----------------------------------------------------------------------------

    def _open(self, first: Write) -> None:
        try:
            self._file = file_of(self.url)
            self._engine = connect(self.url, timeout_s=self._timeout_s)
            self._prepare()
            self._own_name()
            url = self._engine.url
            if url.get_backend_name() == "postgresql" and url.get_driver_name() == "pg8000":
                self._prepared = PreparedStatements(url, timeout_s=self._timeout_s)
            with self._engine.begin() as connection:
                first.made_by(connection)
        except (StateFolderError, StoreError):
            self._close()
            raise
        except (sa.exc.SQLAlchemyError, OSError) as error:
            self._close()
            reason = getattr(error, "orig", None) or error
            raise StoreError(f"cannot open the store {shown_url(self.url)!r}: {reason}") from error

    def _prepare(self) -> None:
        """Create or migrate the schema, with a long timeout."""
        engine = self._connected()
        with engine.connect():
            pass  # Whether anybody is there is found out in the usual time.
        if self._file is None and engine.dialect.name == "sqlite":
            prepare_schema(engine, policy=self._migration)
            return
        long_running = connect(self.url, timeout_s=SCHEMA_TIMEOUT_S)
        try:
            prepare_schema(long_running, policy=self._migration)
        finally:
            long_running.dispose()

    def _own_name(self) -> None:
        if self._worker_id is None:
            return
        if self._file is not None:
            self._owned.enter_context(owned_name(self._file, self._worker_id))
        elif self._connected().dialect.name == "postgresql":
            self._name_on_server = NameOnServer(self._connected(), self._worker_id)
            self._name_on_server.hold()
            self._owned.callback(self._name_on_server.drop)

    def _close(self) -> None:
        self._drop_writer()
        self._owned.close()
        if self._prepared is not None:
            self._prepared.close()
        if self._engine is not None:
            self._engine.dispose()
            self._engine = None


def _driver_of(connection: sa.Connection) -> sqlite3.Connection:
    """SQLite's own connection, for what is no statement of SQLAlchemy's."""
    found = connection.connection.dbapi_connection
    assert found is not None
    return cast("sqlite3.Connection", found)


def _looked_at(work: asyncio.Future[Any]) -> None:
    """Nobody may be left to be told how it ended."""
    if not work.cancelled():
        work.exception()
