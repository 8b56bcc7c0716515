"""The database of a store: statements on a dedicated thread, durability, and failures.

It uses only the table of its probe; ``store`` defines all other tables and their queries.
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
"""Maximum wait of a caller, for its turn and its answer, in timeouts."""
PROBE_S = 1.0
"""Interval of probes of a failing store [s]."""
CHECK_S = 5.0
"""Interval of probes of a healthy store [s]."""
SCHEMA_TIMEOUT_S = 3600.0
"""Timeout of a migration, which may rewrite all tables [s]."""

Durability = Literal["all", "edits", "process"]
"""Writes that are on disk before they are acknowledged: all, all except session steps, or none.
Other writes survive a crash of the process; after a crash of the machine, the last ones may be
lost."""

OnCall = Callable[[str, float, bool], None]
"""Called after a call: ``read`` or ``write``, its seconds, and whether it succeeded."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True, eq=False)
class Write:
    """A writing statement with separate rows; it is compiled only once.

    Attributes:
        statement: the statement; text is passed to the driver unchanged, with tuples as rows.
        rows: parameter rows; the statement is executed once for each.
        prepared: the same as a prepared statement, used if it is alone in its transaction.
        fenced: number of rows that it must change. If it changes fewer, their sessions were taken
            over, and the transaction is rolled back. None for any number.
    """

    statement: sa.Executable | str
    rows: list[dict[str, Any]] | list[tuple[Any, ...]] | None = None
    fenced: int | None = None
    prepared: Prepared | None = None

    def made_by(self, connection: sa.Connection) -> sa.CursorResult[Any]:
        """Execute the statement and return its result."""
        if isinstance(self.statement, str):
            return connection.exec_driver_sql(self.statement, cast("Any", self.rows))
        return connection.execute(self.statement, cast("Any", self.rows))

    def checked(self, changed: int) -> int:
        """Number of changed rows. Raises FencedError."""
        if self.fenced is not None and changed != self.fenced:
            raise FencedError("another worker has taken the session over")
        return changed


class Database:
    """SQLAlchemy Core on a dedicated thread: the event loop never waits for a disk.

    A failing database is detected within ``timeout_s``. From then on, calls are refused immediately
    until a probe of :meth:`watch` succeeds.

    One thread is sufficient: an append takes 0.1 to 0.2 ms in SQLite's write-ahead mode, which
    supports only one writer at a time, and one thread keeps the order of the calls. Code on other
    computing threads may write directly with :meth:`execute`, because switching threads takes
    longer than an append.

    Args:
        url: SQLAlchemy URL; ``sqlite:///path`` or, with its driver installed, ``postgresql://``.
        worker_id: name to hold while the database is open; None for a guest.
        timeout_s: timeout of a statement, a lock, an answer [s].
        durability: writes that are on disk before they are acknowledged.
        migration: whether to migrate a store of an older schema.
        on_call: called after each read and write, on its thread.
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
        """Connect, create missing tables, and execute the first statement.

        Raises:
            StoreError: the database cannot be opened, or has a newer version.
            StateFolderError: another worker of that name uses it.
        """
        await self._run(partial(self._open, first))

    async def close(self) -> None:
        """Finish pending calls and disconnect."""
        await self._run(self._close)
        self._executor.shutdown()

    @property
    def trouble(self) -> StoreTroubleError | None:
        """Failure of the database; None while it is healthy."""
        return self._trouble

    @property
    def is_server(self) -> bool:
        """Whether the database is a server, with its own clock and several writers."""
        return self._connected().dialect.name == "postgresql"

    @property
    def is_file(self) -> bool:
        """Whether the database is an SQLite file."""
        return self._file is not None

    async def watch(self) -> None:
        """Monitor the database until cancelled: detect failures and recoveries."""
        while True:
            await asyncio.sleep(PROBE_S if self._trouble else CHECK_S)
            try:
                await self.on_thread(self._probe)
            except StoreError:
                continue
            except Exception:
                # Catch any error: without this loop, the store would never recover.
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
        """Rows changed by each statement, in one transaction, durable on return.

        Raises:
            ConflictError: a row already exists.
            FencedError: a session was taken over.
        """
        self._refuse_while_down()
        return await self.on_thread(partial(self.execute, changes))

    async def write_returning(self, statement: sa.UpdateBase) -> list[dict[str, Any]]:
        """Rows returned by a writing statement, in its own transaction."""

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
            changes: statements, executed in one transaction.
            promised: whether they matter beyond a session. They are then on disk before this
                returns, unless ``durability`` is ``process``.
        """
        self._refuse_while_down()
        durable = self._durability == "all" or (promised and self._durability == "edits")
        # On a locked file, SQLite sleeps and retries; queueing here is faster.
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
        """Run ``fn()`` on the database's thread, with the usual timeout.

        Raises:
            StoreUnavailableError: ``fn`` did not finish in time.
        """
        return await self._run(fn, patience_s=PATIENCE * self._timeout_s)

    # --- size -------------------------------------------------------------------------------

    async def used_bytes(self) -> int | None:
        """Size of an SQLite database without free pages; None for a server."""
        if self._connected().dialect.name != "sqlite":
            return None
        return await self.on_thread(self._pages_bytes)

    async def give_back(self, pages: int) -> bool:
        """Return free pages of a database file to the disk; returns whether more remain."""
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
                # One step per page. Outside scripts, the driver executes only one step for
                # statements without columns.
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
        """Run ``fn()`` on the database's thread; it completes even if the caller is cancelled.

        Raises:
            StoreUnavailableError: ``fn`` did not finish within ``patience_s``.
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
        """The same for one text statement on a file. Bypasses SQLAlchemy, whose overhead exceeds
        SQLite's time for an append."""
        statement, rows = cast("str", change.statement), change.rows or [()]
        with self._kept_writer(durable=durable) as writer:
            connection = _driver_of(writer)
            # The driver begins a transaction automatically, and rolls it back if a row fails.
            with connection:
                if len(rows) == 1:
                    cursor = connection.execute(statement, cast("Any", rows[0]))
                else:
                    cursor = connection.executemany(statement, cast("Any", rows))
                return change.checked(cursor.rowcount)

    @contextlib.contextmanager
    def _transaction(self, *, durable: bool) -> Iterator[sa.Connection]:
        """A separate transaction, committed at the end; the caller holds the write lock."""
        if self._file is None:
            with self._connected().begin() as connection:
                yield connection
            return
        with self._kept_writer(durable=durable) as writer, writer.begin():
            yield writer

    @contextlib.contextmanager
    def _kept_writer(self, *, durable: bool) -> Iterator[sa.Connection]:
        """The connection that writes to a file, reused unless it fails; the caller holds the write
        lock."""
        if self._writer is None:
            # Borrowing a connection from the pool would take as long as an append.
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
        """Whether the disk was full. The write is then rolled back and the connection stays open:
        if the last connection closed, readers might be unable to create their files."""
        return isinstance(sorted_error(error, folder=self._folder), StoreFullError)

    @property
    def _folder(self) -> Path | None:
        return self._file.parent if self._file else None

    def _set_durable(self, writer: sa.Connection, *, durable: bool) -> None:
        # NORMAL loses committed transactions only if the machine crashes.
        pragma = f"PRAGMA synchronous={'FULL' if durable else 'NORMAL'}"
        _driver_of(writer).execute(pragma).close()
        self._writer_is_durable = durable

    def _drop_writer(self) -> None:
        """Close a failed connection, which may be in any state; the next write opens a new one."""
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.suppress(sa.exc.SQLAlchemyError):
                writer.invalidate()
                writer.close()

    def _connected(self) -> sa.Engine:
        if self._engine is None:
            raise StoreError("the store is not open")
        return self._engine

    # --- failures ---------------------------------------------------------------------------

    def _refuse_while_down(self) -> None:
        trouble = self._trouble
        if isinstance(trouble, StoreUnavailableError):
            raise type(trouble)(trouble.reason)

    def _reraise(self, error: Exception) -> NoReturn:
        """Raise the converted error, and record failures."""
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
        """Check the database: read, and write after a failure."""
        version = t.alembic_version.c.version_num
        try:
            if self._name_on_server is not None:
                self._name_on_server.hold()
            # On a full disk, existing connections still work, but new ones may be unable to create
            # their journal.
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
        """Close all connections to a file. Connections opened while it was read-only stay
        read-only, and so do later ones while one of them is open."""
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
            pass  # Checks the connection, with the usual timeout.
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
    """SQLite's native connection, for calls that are not SQLAlchemy statements."""
    found = connection.connection.dbapi_connection
    assert found is not None
    return cast("sqlite3.Connection", found)


def _looked_at(work: asyncio.Future[Any]) -> None:
    """Retrieve the outcome of abandoned work; otherwise asyncio would log it as unhandled."""
    if not work.cancelled():
        work.exception()
