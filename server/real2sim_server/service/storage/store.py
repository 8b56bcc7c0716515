"""Durable memory of a worker: scenarios, sessions, and stored answers."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any, ParamSpec, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError, IntegrityError

from . import tables as t
from .database import StoreError, connect, is_local, prepare_schema, shown_url
from .rows import ScenarioRow, SessionEntry, SessionRow, SnapshotRow, StoredReply

__all__ = [
    "ConflictError",
    "ScenarioRow",
    "SessionEntry",
    "SessionRow",
    "SnapshotRow",
    "Store",
    "StoreError",
    "StoredReply",
    "Write",
    "now_us",
]

P = ParamSpec("P")
T = TypeVar("T")

REPLY_LIFETIME_US = 24 * 3600 * 1_000_000


class ConflictError(StoreError):
    """A row that must be new exists already: another writer was first."""


@dataclass(frozen=True, eq=False)
class Write:
    """A statement that writes. Rows beside it, not in it, so that it is compiled only once."""

    statement: sa.Executable
    rows: list[dict[str, Any]] | None = None


class Store:
    """SQLAlchemy Core on one thread of its own, so that the event loop never waits for a disk.

    One thread is enough: an append takes 0.1 to 0.2 ms in SQLite's write-ahead mode, which has
    one writer at a time anyway, and the order of appends is the order of the calls. Code that
    computes on another thread may write from there, by :meth:`record` and
    :meth:`record_revision`: to be woken by a thread and to wake another one takes longer than an
    append.

    Args:
        url: SQLAlchemy URL; ``sqlite:///path`` or, with its driver installed, ``postgresql://``.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="store")
        self._write_lock = threading.Lock()
        self._engine: sa.Engine | None = None
        self._writer: sa.Connection | None = None

    async def open(self) -> None:
        """Connect and create what is missing.

        Raises:
            StoreError: the database cannot be opened, or is of a newer version.
        """
        await self._run(self._open)

    async def close(self) -> None:
        """Finish what was begun and disconnect."""
        await self._run(self._close)
        self._executor.shutdown()

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
        self._execute([_insert_rows(t.scenario_log, row), *_reply_writes(reply)])

    async def scenario_entries(self, scenario_id: str) -> list[dict[str, Any]]:
        """The log of a scenario, oldest first."""
        log = t.scenario_log
        query = sa.select(log.c.entry).where(log.c.scenario_id == scenario_id)
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

    async def create_session(self, row: SessionRow, *, reply: StoredReply | None = None) -> None:
        """Add a session, and in the same transaction the answer to the request for it."""
        await self._write(_insert_rows(t.sessions, asdict(row)), *_reply_writes(reply))

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
        reply: StoredReply | None = None,
    ) -> None:
        """Append to a session's log, and the answer to the request for it, all or nothing.

        Raises:
            ConflictError: a ``seq`` is taken, or the session does not exist.
        """
        await self._run(self.record, session_id, entries, reply=reply)

    def record(
        self,
        session_id: str,
        entries: Sequence[SessionEntry],
        *,
        reply: StoredReply | None = None,
    ) -> None:
        """Like :meth:`append_session_entries`, on the calling thread; never on the event loop."""
        rows = [{"session_id": session_id} | vars(entry) for entry in entries]
        if rows:
            self._execute([_insert_rows(t.session_log, *rows), *_reply_writes(reply)])

    async def withdraw(self, session_id: str, *, from_seq: int) -> None:
        """Remove the end of a session's log: what was recorded ahead and never took effect."""
        log = t.session_log
        end = (log.c.session_id == session_id) & (log.c.seq >= from_seq)
        await self._write(Write(sa.delete(log).where(end)))

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

    async def _run(self, fn: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        loop = asyncio.get_running_loop()
        # Shielded: what was handed over is written even when the caller is cancelled.
        work = loop.run_in_executor(self._executor, lambda: fn(*args, **kwargs))
        return await asyncio.shield(work)

    async def _read(self, query: sa.Select[Any]) -> list[dict[str, Any]]:
        def read() -> list[dict[str, Any]]:
            with self._connected().connect() as connection:
                return [dict(row) for row in connection.execute(query).mappings()]

        return await self._run(read)

    async def _write(self, *changes: Write) -> list[int]:
        """Rows changed by each statement, in one transaction."""
        return await self._run(self._execute, changes)

    def _execute(self, changes: Sequence[Write]) -> list[int]:
        try:
            # SQLite lets those who find it locked sleep and try again; they had better queue here.
            with self._write_lock, self._transaction() as connection:
                return [connection.execute(c.statement, c.rows).rowcount for c in changes]
        except DBAPIError as error:
            if _is_conflict(error):
                raise ConflictError(f"not stored: {error.orig}") from error
            raise

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sa.Connection]:
        """A transaction of its own, committed at the end; the caller holds the write lock."""
        if self._writer is None:
            with self._connected().begin() as connection:
                yield connection
        else:
            with self._writer.begin():
                yield self._writer

    def _connected(self) -> sa.Engine:
        if self._engine is None:
            raise StoreError("the store is not open")
        return self._engine

    def _open(self) -> None:
        try:
            self._engine = connect(self.url)
            with self._engine.begin() as connection:
                prepare_schema(connection)
                connection.execute(_delete_old_replies())
            if is_local(self._engine):
                # Fetching a connection from the pool and giving it back takes as long as an append.
                self._writer = self._engine.connect()
        except (sa.exc.SQLAlchemyError, OSError) as error:
            reason = getattr(error, "orig", None) or error
            raise StoreError(f"cannot open the store {shown_url(self.url)!r}: {reason}") from error

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        if self._engine is not None:
            self._engine.dispose()
            self._engine = None


def _is_conflict(error: DBAPIError) -> bool:
    """Whether a row contradicts others (SQLSTATE class 23), in whatever words of the driver."""
    if isinstance(error, IntegrityError):
        return True
    first = error.orig.args[0] if error.orig is not None and error.orig.args else None
    return isinstance(first, dict) and str(first.get("C", "")).startswith("23")


def now_us() -> int:
    """Wall-clock time [us] since 1970 UTC."""
    return time.time_ns() // 1000


def _delete_old_replies() -> sa.Delete:
    table = t.idempotent_replies
    return sa.delete(table).where(table.c.created_us <= now_us() - REPLY_LIFETIME_US)


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


@functools.cache
def _insert(table: sa.Table) -> sa.Insert:
    """One statement for all rows of a table: to recognise a new one as known takes longer."""
    return sa.insert(table)


def _reply_writes(reply: StoredReply | None) -> list[Write]:
    if reply is None:
        return []
    row = asdict(reply) | {"headers": json.dumps(dict(reply.headers)), "created_us": now_us()}
    return [Write(_delete_old_replies()), _insert_rows(t.idempotent_replies, row)]
