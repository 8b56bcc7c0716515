"""Durable memory of a worker: scenarios, sessions, and stored answers."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar

import sqlalchemy as sa
import structlog

from . import tables as t
from .database import connect, file_of, shown_url
from .errors import (
    ConflictError,
    StoreBusyError,
    StoreError,
    StoreTroubleError,
    StoreUnavailableError,
    sorted_error,
)
from .migrations import prepare_schema
from .ownership import StateFolderError, owned_name
from .rows import ScenarioRow, SessionEntry, SessionRow, SnapshotRow, StoredReply
from .server_name import NameOnServer

__all__ = [
    "ConflictError",
    "ScenarioRow",
    "SessionEntry",
    "SessionRow",
    "SnapshotRow",
    "Store",
    "StoreError",
    "StoreTroubleError",
    "StoredReply",
    "Write",
    "now_us",
]

T = TypeVar("T")

ROW_BYTES = 120
"""About what a row of a log takes beside its payload, with its index."""

REPLY_LIFETIME_US = 24 * 3600 * 1_000_000


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
    """A statement that writes. Rows beside it, not in it, so that it is compiled only once."""

    statement: sa.Executable
    rows: list[dict[str, Any]] | None = None


class Store:
    """SQLAlchemy Core on one thread of its own, so that the event loop never waits for a disk.

    A database in trouble is noticed within ``timeout_s``. From then on calls are refused at once,
    until a probe of :meth:`watch` finds it well again.

    One thread is enough: an append takes 0.1 to 0.2 ms in SQLite's write-ahead mode, which has
    one writer at a time anyway, and the order of appends is the order of the calls. Code that
    computes on another thread may write from there, by :meth:`record` and
    :meth:`record_revision`: to be woken by a thread and to wake another one takes longer than an
    append.

    Args:
        url: SQLAlchemy URL; ``sqlite:///path`` or, with its driver installed, ``postgresql://``.
        worker_id: name to hold as long as the store is open; None for a guest.
        timeout_s: of a statement, a lock, an answer [s].
        durability: what reaches the disk before it is acknowledged.
        on_call: told of each read and write, on the thread that did it.
    """

    def __init__(
        self,
        url: str,
        *,
        worker_id: str | None = None,
        timeout_s: float = TIMEOUT_S,
        durability: Durability = "edits",
        on_call: OnCall | None = None,
    ) -> None:
        self.url = url
        self._on_call = on_call
        self._worker_id = worker_id
        self._timeout_s = timeout_s
        self._durability = durability
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

    async def open(self) -> None:
        """Connect and create what is missing.

        Raises:
            StoreError: the database cannot be opened, or is of a newer version.
            StateFolderError: another worker of that name is on it.
        """
        await self._run(self._open)

    async def close(self) -> None:
        """Finish what was begun and disconnect."""
        await self._run(self._close)
        self._executor.shutdown()

    @property
    def trouble(self) -> StoreTroubleError | None:
        """What is wrong with the database; None while it is well."""
        return self._trouble

    async def watch(self) -> None:
        """Look after the database for ever: notice trouble, and its end."""
        while True:
            await asyncio.sleep(PROBE_S if self._trouble else CHECK_S)
            try:
                await self._patiently(self._probe)
            except StoreError:
                continue
            except Exception:
                # Whatever it was: without this watch the store would never be well again.
                log.exception("looking after the store failed")

    # --- scenarios --------------------------------------------------------------------------

    async def create_scenario(
        self,
        row: ScenarioRow,
        *,
        entries: Sequence[Mapping[str, Any]] = (),
        reply: StoredReply | None = None,
    ) -> None:
        """Add a scenario with a log that it may have, and in the same transaction the answer to
        the request for it; ``entries`` hold their revisions."""
        rows = [_log_row(row.scenario_id, e["revision"], e, row.created_us) for e in entries]
        log = [_insert_rows(t.scenario_log, *rows)] if rows else []
        await self._write(_insert_rows(t.scenarios, asdict(row)), *log, *_reply_writes(reply))

    async def scenario(self, scenario_id: str) -> ScenarioRow | None:
        """The scenario of that id."""
        query = sa.select(t.scenarios).where(t.scenarios.c.scenario_id == scenario_id)
        rows = await self._read(query)
        return ScenarioRow(**rows[0]) if rows else None

    async def scenarios(self) -> list[ScenarioRow]:
        """All scenarios, oldest first."""
        query = sa.select(t.scenarios).order_by(t.scenarios.c.created_us, t.scenarios.c.scenario_id)
        return [ScenarioRow(**row) for row in await self._read(query)]

    async def delete_scenario(self, scenario_id: str) -> bool:
        """Remove a scenario and its log; whether there was one."""
        of_scenario = t.scenario_log.c.scenario_id == scenario_id
        counts = await self._write(
            Write(sa.delete(t.scenario_log).where(of_scenario)),
            Write(sa.delete(t.scenario_snapshots).where(_snapshot_of(scenario_id))),
            Write(sa.delete(t.scenarios).where(t.scenarios.c.scenario_id == scenario_id)),
        )
        return counts[-1] > 0

    def record_revision(
        self,
        scenario_id: str,
        revision: int,
        entry: Mapping[str, Any],
        *,
        created_us: int,
        reply: StoredReply | None = None,
    ) -> None:
        """Append one revision, and in the same transaction the answer to the request for it; on the
        calling thread, never on the event loop.

        Args:
            scenario_id: of the scenario.
            revision: next of its log.
            entry: JSON values; ``kind`` among them.
            created_us: wall clock [us].
            reply: stored for a repeated request.

        Raises:
            ConflictError: the revision exists, or the scenario does not.
        """
        row = _log_row(scenario_id, revision, entry, created_us)
        changes = [_insert_rows(t.scenario_log, row), *_reply_writes(reply)]
        self._execute(changes, durable=self._durability != "process")

    async def revision(self, scenario_id: str) -> int | None:
        """Revisions that a scenario has, 0 for none; None where there is no such scenario."""
        log, row = t.scenario_log, t.scenarios
        newest = sa.select(sa.func.max(log.c.revision)).where(log.c.scenario_id == scenario_id)
        query = sa.select(newest.scalar_subquery().label("newest"))
        rows = await self._read(query.select_from(row).where(row.c.scenario_id == scenario_id))
        return (rows[0]["newest"] or 0) if rows else None

    async def scenario_entries(self, scenario_id: str, *, after: int = 0) -> list[dict[str, Any]]:
        """The log of a scenario behind revision ``after``, oldest first."""
        log = t.scenario_log
        query = sa.select(log.c.entry).where(log.c.scenario_id == scenario_id)
        query = query.where(log.c.revision > after)
        rows = await self._read(query.order_by(log.c.revision))
        return [json.loads(row["entry"]) for row in rows]

    async def save_snapshot(self, row: SnapshotRow) -> None:
        """Keep it in place of an older one of its scenario.

        Raises:
            ConflictError: the scenario was deleted.
        """
        await self._write(
            Write(sa.delete(t.scenario_snapshots).where(_snapshot_of(row.scenario_id))),
            _insert_rows(t.scenario_snapshots, asdict(row)),
        )

    async def snapshot(self, scenario_id: str) -> SnapshotRow | None:
        """The last snapshot of a scenario."""
        query = sa.select(t.scenario_snapshots).where(_snapshot_of(scenario_id))
        rows = await self._read(query)
        return SnapshotRow(**rows[0]) if rows else None

    async def scenario_kinds(self) -> dict[str, list[str]]:
        """Kinds of all log entries by scenario, oldest first."""
        log = t.scenario_log
        query = sa.select(log.c.scenario_id, log.c.kind)
        kinds: dict[str, list[str]] = {}
        for row in await self._read(query.order_by(log.c.scenario_id, log.c.revision)):
            kinds.setdefault(row["scenario_id"], []).append(row["kind"])
        return kinds

    async def scenarios_naming(self, asset_id: str) -> list[str]:
        """Scenarios that have an operation with this asset in their log, also if undone."""
        log = t.scenario_log
        named = log.c.entry.contains(f'"asset_id": {json.dumps(asset_id)}', autoescape=True)
        query = sa.select(log.c.scenario_id).where(named).distinct()
        return [row["scenario_id"] for row in await self._read(query.order_by(log.c.scenario_id))]

    # --- sessions ---------------------------------------------------------------------------

    async def create_session(
        self,
        row: SessionRow,
        *,
        entries: Sequence[SessionEntry] = (),
        reply: StoredReply | None = None,
    ) -> None:
        """Add a session with a log that it may have, and in the same transaction the answer to the
        request for it."""
        rows = [{"session_id": row.session_id} | vars(entry) for entry in entries]
        entry_writes = [_insert_rows(t.session_log, *rows)] if rows else []
        await self._write(
            _insert_rows(t.sessions, asdict(row)), *entry_writes, *_reply_writes(reply)
        )

    async def session(self, session_id: str) -> SessionRow | None:
        """The session of that id, open or closed."""
        query = sa.select(t.sessions).where(t.sessions.c.session_id == session_id)
        rows = await self._read(query)
        return SessionRow(**rows[0]) if rows else None

    async def open_sessions(self, worker_id: str) -> list[SessionRow]:
        """Sessions of a worker that were never closed, oldest first."""
        own = (t.sessions.c.worker_id == worker_id) & t.sessions.c.closed_us.is_(None)
        query = sa.select(t.sessions).where(own)
        rows = await self._read(query.order_by(t.sessions.c.created_us, t.sessions.c.session_id))
        return [SessionRow(**row) for row in rows]

    async def close_session(self, session_id: str, *, reason: str) -> None:
        """Note that a session is over; a second time changes nothing."""
        still_open = (t.sessions.c.session_id == session_id) & t.sessions.c.closed_us.is_(None)
        values = {"closed_us": now_us(), "reason": reason}
        await self._write(Write(sa.update(t.sessions).where(still_open).values(values)))

    async def append_session_entries(
        self,
        session_id: str,
        entries: Sequence[SessionEntry],
        *,
        instead: bool = False,
        reply: StoredReply | None = None,
    ) -> None:
        """Append to a session's log, and the answer to the request for it, all or nothing.

        Args:
            session_id: of the session.
            entries: with their places in its log.
            instead: of anything that is there already from the first of those places on.
            reply: stored for a repeated request.

        Raises:
            ConflictError: a ``seq`` is taken, or the session does not exist.
        """
        await self._patiently(
            partial(self.record, session_id, entries, instead=instead, reply=reply)
        )

    def record(
        self,
        session_id: str,
        entries: Sequence[SessionEntry],
        *,
        instead: bool = False,
        reply: StoredReply | None = None,
    ) -> None:
        """Like :meth:`append_session_entries`, on the calling thread; never on the event loop."""
        rows = [{"session_id": session_id} | vars(entry) for entry in entries]
        if not rows:
            return
        changes = [_insert_rows(t.session_log, *rows), *_reply_writes(reply)]
        if instead:
            changes.insert(0, _log_end(session_id, entries[0].seq))
        # A stored answer is a promise beyond the session.
        durable = reply is not None and self._durability != "process"
        self._execute(changes, durable=durable or self._durability == "all")

    def record_together(self, logs: Sequence[tuple[str, Sequence[SessionEntry]]]) -> None:
        """Entries of several sessions by :meth:`record` in one transaction: all, or none of them.

        Args:
            logs: ids of sessions, and what their logs get.
        """
        rows = [{"session_id": session} | vars(entry) for session, log in logs for entry in log]
        if rows:
            self._execute([_insert_rows(t.session_log, *rows)], durable=self._durability == "all")

    async def withdraw(
        self, session_id: str, *, from_seq: int, replies: Sequence[str] = ()
    ) -> None:
        """Remove the end of a session's log, and answers by their keys: what was recorded ahead and
        never took effect."""
        told = t.idempotent_replies.c.key.in_(replies)
        forgotten = [Write(sa.delete(t.idempotent_replies).where(told))] if replies else []
        await self._write(_log_end(session_id, from_seq), *forgotten)

    async def session_entries(self, session_id: str, *, after: int = -1) -> list[SessionEntry]:
        """The log of a session behind ``after``, oldest first."""
        log = t.session_log
        query = sa.select(log.c.seq, log.c.kind, log.c.step, log.c.payload, log.c.created_us)
        query = query.where((log.c.session_id == session_id) & (log.c.seq > after))
        return [SessionEntry(**row) for row in await self._read(query.order_by(log.c.seq))]

    # --- answers ----------------------------------------------------------------------------

    async def reply(self, key: str) -> StoredReply | None:
        """The answer kept under ``key``, for 24 hours."""
        table = t.idempotent_replies
        fresh = table.c.created_us > now_us() - REPLY_LIFETIME_US
        rows = await self._read(sa.select(table).where((table.c.key == key) & fresh))
        if not rows:
            return None
        row = rows[0]
        headers = json.loads(row["headers"])
        return StoredReply(key, row["fingerprint"], row["status"], headers, row["body"])

    async def forget_old_replies(self) -> None:
        """Remove the answers that are kept no longer."""
        await self._write(Write(_delete_old_replies()))

    # --- size -------------------------------------------------------------------------------

    async def size_bytes(self) -> int:
        """What the store takes, without what it could give back; of a server about its logs."""
        if self._connected().dialect.name == "sqlite":
            return await self._patiently(self._pages_bytes)
        log = t.session_log
        payload = sa.func.coalesce(sa.func.sum(sa.func.length(log.c.payload)), 0)
        query = sa.select(payload.label("bytes"), sa.func.count().label("rows")).select_from(log)
        (row,) = await self._read(query)
        return int(row["bytes"]) + ROW_BYTES * int(row["rows"])

    async def give_back(self, pages: int) -> bool:
        """Give free pages of a database file back to the disk; whether there are more."""
        if self._file is None:
            return False
        return await self._patiently(partial(self._shrink, pages))

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
                raw = connection.connection.dbapi_connection
                assert raw is not None
                cursor = raw.cursor()
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

    # --- other tables -------------------------------------------------------------------

    async def read(self, query: sa.Select[Any]) -> list[dict[str, Any]]:
        """Rows of a query."""
        return await self._read(query)

    async def write(self, *changes: Write, reply: StoredReply | None = None) -> list[int]:
        """Rows changed by each statement, in one transaction, also with the answer to a request.

        Raises:
            ConflictError: a row that must be new exists.
        """
        return await self._write(*changes, *_reply_writes(reply))

    # --- inside -----------------------------------------------------------------------------

    async def _run(self, fn: Callable[[], T], *, patience_s: float | None = None) -> T:
        """``fn()`` on the store's thread; done also when the caller is cancelled or has left.

        Raises:
            StoreUnavailableError: it was not done within ``patience_s``.
        """
        work = asyncio.get_running_loop().run_in_executor(self._executor, fn)
        work.add_done_callback(_looked_at)
        done, _ = await asyncio.wait((work,), timeout=patience_s)
        if not done:
            raise self._noted(StoreUnavailableError(f"no answer within {patience_s:g} s"))
        return work.result()

    async def _patiently(self, fn: Callable[[], T]) -> T:
        return await self._run(fn, patience_s=PATIENCE * self._timeout_s)

    async def _read(self, query: sa.Select[Any]) -> list[dict[str, Any]]:
        def read() -> list[dict[str, Any]]:
            self._refuse_while_down()
            try:
                with self._timed("read"), self._connected().connect() as connection:
                    return [dict(row) for row in connection.execute(query).mappings()]
            except Exception as error:
                self._reraise(error)

        self._refuse_while_down()
        return await self._patiently(read)

    async def _write(self, *changes: Write) -> list[int]:
        """Rows changed by each statement, in one transaction."""
        self._refuse_while_down()
        durable = self._durability != "process"
        return await self._patiently(partial(self._execute, changes, durable=durable))

    def _execute(self, changes: Sequence[Write], *, durable: bool) -> list[int]:
        self._refuse_while_down()
        # SQLite lets those who find it locked sleep and try again; they had better queue here.
        if not self._write_lock.acquire(timeout=self._timeout_s):
            raise self._noted(StoreUnavailableError("the write before this one has not ended"))
        try:
            with self._timed("write"), self._transaction(durable=durable) as connection:
                counts = [connection.execute(c.statement, c.rows).rowcount for c in changes]
        except Exception as error:
            self._reraise(error)
        finally:
            self._write_lock.release()
        if self._trouble is not None:
            self._recovered()
        return counts

    @contextlib.contextmanager
    def _timed(self, kind: str) -> Iterator[None]:
        started, done = time.perf_counter(), False
        try:
            yield
            done = True
        finally:
            if self._on_call is not None:
                self._on_call(kind, time.perf_counter() - started, done)

    @contextlib.contextmanager
    def _transaction(self, *, durable: bool) -> Iterator[sa.Connection]:
        """A transaction of its own, committed at the end; the caller holds the write lock."""
        if self._file is None:
            with self._connected().begin() as connection:
                yield connection
            return
        if self._writer is None:
            # Fetching a connection from the pool and giving it back takes as long as an append.
            self._writer, self._writer_is_durable = self._connected().connect(), False
        if durable != self._writer_is_durable:
            self._set_durable(self._writer, durable=durable)
        try:
            with self._writer.begin():
                yield self._writer
        except Exception as error:
            if not isinstance(error, sa.exc.IntegrityError):
                self._drop_writer()
            raise

    def _set_durable(self, writer: sa.Connection, *, durable: bool) -> None:
        # NORMAL loses no committed transaction when the process dies, only when the machine does.
        pragma = f"PRAGMA synchronous={'FULL' if durable else 'NORMAL'}"
        connection = writer.connection.dbapi_connection
        assert connection is not None
        cursor = connection.cursor()
        cursor.execute(pragma)
        cursor.close()
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
        found = sorted_error(error, folder=self._file.parent if self._file else None)
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
        version = t.schema_version.c.version
        try:
            if self._name_on_server is not None:
                self._name_on_server.hold()
            if self._trouble is not None and self._file is not None:
                self._reconnect()
            with self._connected().connect() as connection:
                connection.execute(sa.select(version)).all()
            if self._trouble is None:
                return
            with self._write_lock, self._transaction(durable=True) as connection:
                connection.execute(sa.update(t.schema_version).values(version=version))
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

    def _open(self) -> None:
        try:
            self._file = file_of(self.url)
            self._engine = connect(self.url, timeout_s=self._timeout_s)
            self._prepare()
            self._own_name()
            with self._engine.begin() as connection:
                connection.execute(_delete_old_replies())
        except (StateFolderError, StoreError):
            self._close()
            raise
        except (sa.exc.SQLAlchemyError, OSError) as error:
            self._close()
            reason = getattr(error, "orig", None) or error
            raise StoreError(f"cannot open the store {shown_url(self.url)!r}: {reason}") from error

    def _prepare(self) -> None:
        """Bring the schema up to date, with time enough for it."""
        engine = self._connected()
        with engine.connect():
            pass  # Whether anybody is there is found out in the usual time.
        if self._file is None and engine.dialect.name == "sqlite":
            prepare_schema(engine)
            return
        long_running = connect(self.url, timeout_s=SCHEMA_TIMEOUT_S)
        try:
            prepare_schema(long_running)
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
        if self._engine is not None:
            self._engine.dispose()
            self._engine = None


def _looked_at(work: asyncio.Future[Any]) -> None:
    """Nobody may be left to be told how it ended."""
    if not work.cancelled():
        work.exception()


def now_us() -> int:
    """Wall-clock time [us] since 1970 UTC; never less than before in this process.

    What is stored is listed in the order of these times, also when the clock is set back.
    """
    return _clock.read()


class _Clock:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0

    def read(self) -> int:
        with self._lock:
            self._last = max(self._last + 1, time.time_ns() // 1000)
            return self._last


_clock = _Clock()


def _delete_old_replies() -> sa.Delete:
    table = t.idempotent_replies
    return sa.delete(table).where(table.c.created_us <= now_us() - REPLY_LIFETIME_US)


def _log_end(session_id: str, from_seq: int) -> Write:
    log = t.session_log
    end = (log.c.session_id == session_id) & (log.c.seq >= from_seq)
    return Write(sa.delete(log).where(end))


def _snapshot_of(scenario_id: str) -> sa.ColumnElement[bool]:
    return t.scenario_snapshots.c.scenario_id == scenario_id


def _log_row(
    scenario_id: str, revision: int, entry: Mapping[str, Any], created_us: int
) -> dict[str, Any]:
    return {
        "scenario_id": scenario_id,
        "revision": revision,
        "kind": entry["kind"],
        "entry": json.dumps(entry, allow_nan=False),
        "created_us": created_us,
    }


def _insert_rows(table: sa.Table, *rows: Mapping[str, Any]) -> Write:
    return Write(_insert(table), [dict(row) for row in rows])


@cache
def _insert(table: sa.Table) -> sa.Insert:
    """One statement for all rows of a table: to recognise a new one as known takes longer."""
    return sa.insert(table)


def _reply_writes(reply: StoredReply | None) -> list[Write]:
    if reply is None:
        return []
    row = asdict(reply) | {"headers": json.dumps(dict(reply.headers)), "created_us": now_us()}
    return [Write(_delete_old_replies()), _insert_rows(t.idempotent_replies, row)]
