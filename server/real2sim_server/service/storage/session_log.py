"""Statements that write the logs of sessions, each only for the worker that has the session.

A worker that slept for longer than its lease may wake up in the middle of a step, while another one
goes on with its session. So whoever writes shows the epoch of its claim, and the statement that
writes compares it with the session's, in the database: there is no instant between the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import chain

import sqlalchemy as sa

from . import tables as t
from .database import Write
from .prepared import Prepared
from .rows import Claim, SessionEntry

ClaimedEntries = tuple[Claim, Sequence[SessionEntry]]
"""What a session's log gets, and by which right."""

MOST_ROWS = 32
"""Entries that one statement appends; more of them take turns."""

COLUMNS = "session_id, seq, kind, step, payload, created_us"
TYPES = ("VARCHAR(80)", "INTEGER", "VARCHAR(16)", "INTEGER", "BYTEA", "BIGINT", "INTEGER")
"""Of the columns and the epoch, in PostgreSQL."""


def appended(logs: Sequence[ClaimedEntries], *, on_server: bool) -> list[Write]:
    """What appends entries to the logs of sessions.

    Args:
        logs: of one session or of several.
        on_server: whether the database is PostgreSQL.
    """
    values = [
        (claim.session_id, *vars(entry).values(), claim.epoch)
        for claim, entries in logs
        for entry in entries
    ]
    if on_server:
        pieces = [values[k : k + MOST_ROWS] for k in range(0, len(values), MOST_ROWS)]
        return [_appended_on_server(piece) for piece in pieces]
    if len(values) > MOST_ROWS:
        return [Write(_append(1), values, fenced=len(values))]
    return [Write(_append(len(values)), [tuple(chain.from_iterable(values))], fenced=len(values))]


def withdrawn(claim: Claim, from_seq: int) -> list[Write]:
    """What removes the end of a session's log."""
    s, log = t.sessions.c, t.session_log.c
    mine = (s.session_id == claim.session_id) & (s.epoch == claim.epoch)
    end = (log.session_id == claim.session_id) & (log.seq >= from_seq)
    # Changes nothing; holds the row, so that nobody takes the session over meanwhile.
    held = sa.update(t.sessions).where(mine).values(epoch=claim.epoch)
    return [Write(held, fenced=1), Write(sa.delete(t.session_log).where(end))]


@cache
def _append(rows: int) -> str:
    """The statement that appends entries, for SQLite.

    Every step of a session makes one: to have the statement put together by SQLAlchemy takes as
    long as the append. Of many in one go the driver gives the interpreter up but once, not for
    every row, and other threads keep it longer than a row takes.
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
    # Of one session all rows are written or none: the statement needs no transaction around it.
    alone = len({row[0] for row in values}) == 1
    prepared = Prepared(f"{text.text} RETURNING 1", given) if alone else None
    return Write(text.bindparams(**given), fenced=len(values), prepared=prepared)


@cache
def _append_on_server(rows: int) -> sa.TextClause:
    """The same for PostgreSQL. ``FOR SHARE`` waits for whoever is just taking a session over, and
    looks at its epoch again."""
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
