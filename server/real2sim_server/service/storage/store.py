"""Persistent scenarios, sessions and replies of a worker."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache, partial
from itertools import chain
from typing import Any

import sqlalchemy as sa

from ..clock import now_us
from . import schema as t
from .connection import ConflictError, FencedError, Prepared, StoreError, StoreTroubleError
from .database import TIMEOUT_S, Database, Durability, OnCall, Write
from .schema import Claim, Policy, ScenarioRow, SessionEntry, SessionRow, SnapshotRow, StoredReply

# --- Session logs --------------------------------------------------------------------------------

# A worker that was suspended for longer than its lease may resume in the middle of a step, after
# another worker has taken over the session. Each write therefore carries the epoch of its claim,
# and the statement compares it with the session's epoch in the database.

ClaimedEntries = tuple[Claim, Sequence[SessionEntry]]
"""Entries for a session's log, and the claim on the session."""

MAX_ROWS = 32
"""Maximum number of entries per statement."""

COLUMNS = "session_id, seq, kind, step, payload, created_us"
TYPES = ("VARCHAR(80)", "INTEGER", "VARCHAR(16)", "INTEGER", "BYTEA", "BIGINT", "INTEGER")
"""PostgreSQL types of the columns and the epoch."""


def appended(logs: Sequence[ClaimedEntries], *, on_server: bool) -> list[Write]:
    """Statements that append entries to the logs of sessions.

    Args:
        logs: one or more logs.
        on_server: whether the database is PostgreSQL.
    """
    values = [
        (claim.session_id, *vars(entry).values(), claim.epoch)
        for claim, entries in logs
        for entry in entries
    ]
    if on_server:
        pieces = [values[k : k + MAX_ROWS] for k in range(0, len(values), MAX_ROWS)]
        return [_appended_on_server(piece) for piece in pieces]
    if len(values) > MAX_ROWS:
        return [Write(_append(1), values, fenced=len(values))]
    return [Write(_append(len(values)), [tuple(chain.from_iterable(values))], fenced=len(values))]


def withdrawn(claim: Claim, from_seq: int) -> list[Write]:
    """Statements that remove the end of a session's log."""
    s, log = t.sessions.c, t.session_log.c
    mine = (s.session_id == claim.session_id) & (s.epoch == claim.epoch)
    end = (log.session_id == claim.session_id) & (log.seq >= from_seq)
    # Changes nothing, but locks the row against a takeover of the session.
    held = sa.update(t.sessions).where(mine).values(epoch=claim.epoch)
    return [Write(held, fenced=1), Write(sa.delete(t.session_log).where(end))]


@cache
def _append(rows: int) -> str:
    """The statement that appends entries, for SQLite.

    Every step of a session executes it, and assembling it in SQLAlchemy would take as long as the
    append. For many rows in one statement, the driver releases the GIL only once. If it released
    the GIL per row, other threads would hold it for longer than a row takes.
    """
    values = ", ".join(["(?, ?, ?, ?, ?, ?, ?)"] * rows)
    given = ", ".join(f"v.column{k}" for k in range(1, 7))
    return (
        f"INSERT INTO session_log ({COLUMNS}) SELECT {given} FROM (VALUES {values}) AS v "
        "CROSS JOIN sessions AS s ON s.session_id = v.column1 AND s.epoch = v.column7"
    )


def _appended_on_server(values: Sequence[tuple[object, ...]]) -> Write:
    given = {f"v{k}": value for k, value in enumerate(chain.from_iterable(values))}
    text = _append_on_server(len(values))
    # The statement writes all rows of a session or none, so it needs no transaction.
    alone = len({row[0] for row in values}) == 1
    prepared = Prepared(f"{text.text} RETURNING 1", given) if alone else None
    return Write(text.bindparams(**given), fenced=len(values), prepared=prepared)


@cache
def _append_on_server(rows: int) -> sa.TextClause:
    """The same for PostgreSQL. ``FOR SHARE`` waits for a concurrent takeover of the session, and
    then checks its epoch again."""
    width = len(TYPES)
    values = ", ".join(
        "(" + ", ".join(f"CAST(:v{row * width + k} AS {TYPES[k]})" for k in range(width)) + ")"
        for row in range(rows)
    )
    return sa.text(
        f"INSERT INTO session_log ({COLUMNS}) "
        "SELECT v.session_id, v.seq, v.kind, v.step, v.payload, v.created_us "
        f"FROM (VALUES {values}) AS v ({COLUMNS}, epoch) JOIN sessions AS s "
        "ON s.session_id = v.session_id AND s.epoch = v.epoch FOR SHARE OF s"
    )


__all__ = [
    "Claim",
    "ConflictError",
    "FencedError",
    "ScenarioRow",
    "SessionEntry",
    "SessionRow",
    "SnapshotRow",
    "Store",
    "StoreError",
    "StoreTroubleError",
    "StoredReply",
    "Write",
]

ROW_BYTES = 120
"""Approximate size of a log row without its payload, including its index [bytes]."""

REPLY_LIFETIME_US = 24 * 3600 * 1_000_000


class Store:
    """Queries and writes of the database.

    Computing threads may write with :meth:`record` and :meth:`record_revision`, see
    :class:`.database.Database`.

    Args:
        url: SQLAlchemy URL; ``sqlite:///path`` or, with its driver installed, ``postgresql://``.
        worker_id: name to hold while the store is open; None for a guest.
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
        self.database = Database(
            url,
            worker_id=worker_id,
            timeout_s=timeout_s,
            durability=durability,
            migration=migration,
            on_call=on_call,
        )

    async def open(self) -> None:
        """Connect and create missing tables.

        Raises:
            StoreError: the database cannot be opened, or has a newer version.
            StateFolderError: another worker with that name uses the store.
        """
        await self.database.open(Write(_delete_old_replies()))

    async def close(self) -> None:
        """Finish pending calls and disconnect."""
        await self.database.close()

    @property
    def trouble(self) -> StoreTroubleError | None:
        """Failure of the database; None while it is healthy."""
        return self.database.trouble

    async def watch(self) -> None:
        """Monitor the database until cancelled: detect failures and recoveries."""
        await self.database.watch()

    # --- scenarios --------------------------------------------------------------------------

    async def create_scenario(
        self,
        row: ScenarioRow,
        *,
        entries: Sequence[Mapping[str, Any]] = (),
        reply: StoredReply | None = None,
    ) -> None:
        """Add a scenario with an optional log and, in the same transaction, the reply to its
        request; ``entries`` include their revisions."""
        rows = [_log_row(row.scenario_id, e["revision"], e, row.created_us) for e in entries]
        log = [_insert_rows(t.scenario_log, *rows)] if rows else []
        await self.database.write(
            _insert_rows(t.scenarios, asdict(row)), *log, *_reply_writes(reply)
        )

    async def scenario(self, scenario_id: str) -> ScenarioRow | None:
        """The scenario with that id."""
        query = sa.select(t.scenarios).where(t.scenarios.c.scenario_id == scenario_id)
        rows = await self.database.read(query)
        return ScenarioRow(**rows[0]) if rows else None

    async def scenarios(self) -> list[ScenarioRow]:
        """All scenarios, oldest first."""
        query = sa.select(t.scenarios).order_by(t.scenarios.c.created_us, t.scenarios.c.scenario_id)
        return [ScenarioRow(**row) for row in await self.database.read(query)]

    async def delete_scenario(self, scenario_id: str) -> bool:
        """Delete a scenario and its log; returns whether it existed."""
        of_scenario = t.scenario_log.c.scenario_id == scenario_id
        counts = await self.database.write(
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
        """Append one revision and, in the same transaction, the reply to its request.

        Runs on the calling thread; do not call it on the event loop.

        Args:
            scenario_id: the scenario.
            revision: next revision of its log.
            entry: JSON values, including ``kind``.
            created_us: wall clock [us].
            reply: stored for repeated requests.

        Raises:
            ConflictError: the revision exists, or the scenario does not.
        """
        row = _log_row(scenario_id, revision, entry, created_us)
        changes = [_insert_rows(t.scenario_log, row), *_reply_writes(reply)]
        self.database.execute(changes)

    async def rename_scenario(self, scenario_id: str, name: str) -> bool:
        """Rename a scenario; returns whether it exists."""
        of_scenario = t.scenarios.c.scenario_id == scenario_id
        changes = sa.update(t.scenarios).where(of_scenario).values(name=name)
        return (await self.database.write(Write(changes)))[-1] > 0

    async def newest_of_scenario(self, scenario_id: str) -> tuple[int, str] | None:
        """Number of revisions of a scenario, and its name; None if the scenario does not exist."""
        log, row = t.scenario_log, t.scenarios
        newest = sa.select(sa.func.max(log.c.revision)).where(log.c.scenario_id == scenario_id)
        query = sa.select(newest.scalar_subquery().label("newest"), row.c.name)
        rows = await self.database.read(
            query.select_from(row).where(row.c.scenario_id == scenario_id)
        )
        return (rows[0]["newest"] or 0, rows[0]["name"]) if rows else None

    async def scenario_entries(self, scenario_id: str, *, after: int = 0) -> list[dict[str, Any]]:
        """The log of a scenario after revision ``after``, oldest first."""
        log = t.scenario_log
        query = sa.select(log.c.entry).where(log.c.scenario_id == scenario_id)
        query = query.where(log.c.revision > after)
        rows = await self.database.read(query.order_by(log.c.revision))
        return [json.loads(row["entry"]) for row in rows]

    async def save_snapshot(self, row: SnapshotRow) -> None:
        """Store a snapshot, replacing an older one of its scenario.

        Raises:
            ConflictError: the scenario was deleted.
        """
        await self.database.write(
            Write(sa.delete(t.scenario_snapshots).where(_snapshot_of(row.scenario_id))),
            _insert_rows(t.scenario_snapshots, asdict(row)),
        )

    async def snapshot(self, scenario_id: str) -> SnapshotRow | None:
        """The last snapshot of a scenario."""
        query = sa.select(t.scenario_snapshots).where(_snapshot_of(scenario_id))
        rows = await self.database.read(query)
        return SnapshotRow(**rows[0]) if rows else None

    async def scenario_kinds(self) -> dict[str, list[str]]:
        """Kinds of all log entries by scenario, oldest first."""
        log = t.scenario_log
        query = sa.select(log.c.scenario_id, log.c.kind)
        kinds: dict[str, list[str]] = {}
        for row in await self.database.read(query.order_by(log.c.scenario_id, log.c.revision)):
            kinds.setdefault(row["scenario_id"], []).append(row["kind"])
        return kinds

    async def scenarios_naming(self, asset_id: str) -> list[str]:
        """Scenarios whose log has an operation with this asset, including undone ones."""
        log = t.scenario_log
        named = log.c.entry.contains(f'"asset_id": {json.dumps(asset_id)}', autoescape=True)
        query = sa.select(log.c.scenario_id).where(named).distinct()
        return [
            row["scenario_id"]
            for row in await self.database.read(query.order_by(log.c.scenario_id))
        ]

    # --- sessions ---------------------------------------------------------------------------

    async def create_session(
        self,
        row: SessionRow,
        *,
        entries: Sequence[SessionEntry] = (),
        reply: StoredReply | None = None,
    ) -> None:
        """Add a session with an optional log and, in the same transaction, the reply to its
        request."""
        rows = [{"session_id": row.session_id} | vars(entry) for entry in entries]
        entry_writes = [_insert_rows(t.session_log, *rows)] if rows else []
        await self.database.write(
            _insert_rows(t.sessions, asdict(row)), *entry_writes, *_reply_writes(reply)
        )

    async def session(self, session_id: str) -> SessionRow | None:
        """The session with that id, open or closed."""
        query = sa.select(t.sessions).where(t.sessions.c.session_id == session_id)
        rows = await self.database.read(query)
        return SessionRow(**rows[0]) if rows else None

    async def open_sessions(self, worker_id: str) -> list[SessionRow]:
        """Sessions of a worker that were never closed, oldest first."""
        own = (t.sessions.c.worker_id == worker_id) & t.sessions.c.closed_us.is_(None)
        query = sa.select(t.sessions).where(own)
        rows = await self.database.read(
            query.order_by(t.sessions.c.created_us, t.sessions.c.session_id)
        )
        return [SessionRow(**row) for row in rows]

    async def close_session(self, claim: Claim, *, reason: str) -> None:
        """Mark a session as ended; idempotent. No effect if another worker has the session."""
        s = t.sessions.c
        still_open = (s.session_id == claim.session_id) & s.closed_us.is_(None)
        mine = still_open & (s.epoch == claim.epoch)
        values = {"closed_us": now_us(), "reason": reason}
        await self.database.write(Write(sa.update(t.sessions).where(mine).values(values)))

    async def append_session_entries(
        self,
        claim: Claim,
        entries: Sequence[SessionEntry],
        *,
        instead: bool = False,
        reply: StoredReply | None = None,
    ) -> None:
        """Append entries to a session's log, and the reply to their request, atomically.

        Args:
            claim: claim on the session.
            entries: entries with their positions in the log.
            instead: whether to replace existing entries from the first position.
            reply: stored for repeated requests.

        Raises:
            ConflictError: a ``seq`` is taken.
            FencedError: another worker has the session, or it does not exist.
        """
        await self.database.on_thread(
            partial(self.record, claim, entries, instead=instead, reply=reply)
        )

    def record(
        self,
        claim: Claim,
        entries: Sequence[SessionEntry],
        *,
        instead: bool = False,
        reply: StoredReply | None = None,
    ) -> None:
        """Like :meth:`append_session_entries`, on the calling thread; never on the event loop."""
        if not entries:
            return
        changes = [*self._append([(claim, entries)]), *_reply_writes(reply)]
        if instead:
            changes = [*withdrawn(claim, entries[0].seq), *changes]
        # A stored reply must be durable beyond the session.
        self.database.execute(changes, promised=reply is not None)

    def record_together(self, logs: Sequence[ClaimedEntries]) -> None:
        """Store entries of several sessions in one transaction, as :meth:`record` does.

        Args:
            logs: claims on sessions, and their entries.
        """
        if any(entries for _, entries in logs):
            self.database.execute(self._append(logs), promised=False)

    def _append(self, logs: Sequence[ClaimedEntries]) -> list[Write]:
        return appended(logs, on_server=self.database.is_server)

    async def withdraw(self, claim: Claim, *, from_seq: int, replies: Sequence[str] = ()) -> None:
        """Remove the end of a session's log, and replies by their keys; both were stored ahead of
        time and never took effect.

        Raises:
            FencedError: another worker has the session.
        """
        told = t.idempotent_replies.c.key.in_(replies)
        forgotten = [Write(sa.delete(t.idempotent_replies).where(told))] if replies else []
        await self.database.write(*withdrawn(claim, from_seq), *forgotten)

    async def session_entries(self, session_id: str, *, after: int = -1) -> list[SessionEntry]:
        """The log of a session after ``after``, oldest first."""
        log = t.session_log
        query = sa.select(log.c.seq, log.c.kind, log.c.step, log.c.payload, log.c.created_us)
        query = query.where((log.c.session_id == session_id) & (log.c.seq > after))
        return [SessionEntry(**row) for row in await self.database.read(query.order_by(log.c.seq))]

    # --- replies ----------------------------------------------------------------------------

    async def reply(self, key: str) -> StoredReply | None:
        """The reply stored under ``key``, for 24 hours."""
        table = t.idempotent_replies
        fresh = table.c.created_us > now_us() - REPLY_LIFETIME_US
        rows = await self.database.read(sa.select(table).where((table.c.key == key) & fresh))
        if not rows:
            return None
        row = rows[0]
        headers = json.loads(row["headers"])
        return StoredReply(key, row["fingerprint"], row["status"], headers, row["body"])

    async def forget_old_replies(self) -> None:
        """Delete expired replies."""
        await self.database.write(Write(_delete_old_replies()))

    # --- size -------------------------------------------------------------------------------

    async def size_bytes(self) -> int:
        """Size of the store without free pages; for a server, approximate size of its logs."""
        used = await self.database.used_bytes()
        if used is not None:
            return used
        log = t.session_log
        payload = sa.func.coalesce(sa.func.sum(sa.func.length(log.c.payload)), 0)
        query = sa.select(payload.label("bytes"), sa.func.count().label("rows")).select_from(log)
        (row,) = await self.database.read(query)
        return int(row["bytes"]) + ROW_BYTES * int(row["rows"])

    async def give_back(self, pages: int) -> bool:
        """Return free pages of a database file to the disk; returns whether more remain."""
        return await self.database.give_back(pages)

    # --- other tables -------------------------------------------------------------------

    async def read(self, query: sa.Select[Any]) -> list[dict[str, Any]]:
        """Rows of a query."""
        return await self.database.read(query)

    async def write(self, *changes: Write, reply: StoredReply | None = None) -> list[int]:
        """Rows changed by each statement, in one transaction, optionally with the reply to a
        request.

        Raises:
            ConflictError: a row already exists.
        """
        return await self.database.write(*changes, *_reply_writes(reply))


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


@cache
def _insert(table: sa.Table) -> sa.Insert:
    """One statement for all rows of a table; caching new statements would be slower."""
    return sa.insert(table)


def _reply_writes(reply: StoredReply | None) -> list[Write]:
    if reply is None:
        return []
    row = asdict(reply) | {"headers": json.dumps(dict(reply.headers)), "created_us": now_us()}
    return [Write(_delete_old_replies()), _insert_rows(t.idempotent_replies, row)]
