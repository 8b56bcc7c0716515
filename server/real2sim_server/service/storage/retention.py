"""What a store lets go of: ended sessions after a time, and the oldest of them above a size.

Scenarios are never removed but by who asks for it. Everything goes in small pieces, with room for
others between them: a step that is recorded meanwhile waits for one piece at most.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import sqlalchemy as sa
import structlog

from ..clock import now_us
from . import tables as t
from .store import Claim, Store, Write

DAY_US = 86_400 * 1_000_000
PIECE_ROWS = 1000
PIECE_PAGES = 256
SESSIONS_AT_ONCE = 8
BREATH_S = 0.01
"""Between two pieces."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class RetentionLimits:
    """What a store may keep.

    Attributes:
        session_days: an ended session is kept for so long after its end, and one that nobody uses
            is ended after so long.
        max_bytes: above which the oldest ended sessions go earlier.
    """

    session_days: float
    max_bytes: int


class Retention:
    """Keeps the store of a worker within its limits.

    Args:
        store: open while this is used.
        limits: what it may keep.
        worker_id: whose unused sessions are ended.
    """

    def __init__(self, store: Store, limits: RetentionLimits, *, worker_id: str) -> None:
        self._store = store
        self._limits = limits
        self._worker_id = worker_id

    async def tidy(self, *, in_use: Collection[str] = ()) -> int:
        """Let go of what is beyond the limits; the sessions that went.

        Args:
            in_use: open sessions that are in memory.

        Raises:
            StoreTroubleError: the store is in trouble; the rest goes another time.
        """
        cutoff_us = now_us() - round(self._limits.session_days * DAY_US)
        await self._end_unused(cutoff_us, in_use)
        removed = 0
        while rows := await self._ended(before_us=cutoff_us):
            removed += await self._remove(rows)
        while await self._store.size_bytes() > self._limits.max_bytes:
            rows = await self._ended()
            if not rows:
                log.warning(
                    "store above its limit",
                    bytes=await self._store.size_bytes(),
                    limit=self._limits.max_bytes,
                    advice="delete scenarios, end sessions, or raise REAL2SIM_STORE_MAX_BYTES",
                )
                break
            removed += await self._remove(rows)
        await self._store.forget_old_replies()
        while await self._store.give_back(PIECE_PAGES):
            await asyncio.sleep(BREATH_S)
        if removed:
            log.info("ended sessions removed", sessions=removed)
        return removed

    async def _end_unused(self, cutoff_us: int, in_use: Collection[str]) -> None:
        """End the sessions that nobody has used since ``cutoff_us``."""
        s, entry = t.sessions, t.session_log
        newest = (
            sa.select(entry.c.created_us)
            .where(entry.c.session_id == s.c.session_id)
            .order_by(entry.c.seq.desc())
            .limit(1)
            .scalar_subquery()
        )
        mine = (s.c.worker_id == self._worker_id) & s.c.closed_us.is_(None)
        unused = sa.func.coalesce(newest, s.c.created_us) < cutoff_us
        query = sa.select(s.c.session_id, s.c.epoch)
        query = query.where(mine & (s.c.created_us < cutoff_us) & unused)
        for row in await self._store.read(query):
            if row["session_id"] not in in_use:
                reason = f"nobody has used it for {self._limits.session_days:g} days"
                await self._store.close_session(Claim(**row), reason=reason)

    async def _ended(self, *, before_us: int | None = None) -> Sequence[str]:
        """Some ended sessions, those that ended first."""
        closed = t.sessions.c.closed_us
        query = sa.select(t.sessions.c.session_id).where(closed.is_not(None))
        if before_us is not None:
            query = query.where(closed < before_us)
        rows = await self._store.read(query.order_by(closed).limit(SESSIONS_AT_ONCE))
        return [row["session_id"] for row in rows]

    async def _remove(self, session_ids: Sequence[str]) -> int:
        for session_id in session_ids:
            entry = t.session_log.c
            newest = sa.select(sa.func.max(entry.seq).label("seq"))
            (row,) = await self._store.read(newest.where(entry.session_id == session_id))
            for bound in range(PIECE_ROWS, (row["seq"] or 0) + 1, PIECE_ROWS):
                piece = (entry.session_id == session_id) & (entry.seq < bound)
                await self._store.write(Write(sa.delete(t.session_log).where(piece)))
                await asyncio.sleep(BREATH_S)
            await self._store.write(
                Write(sa.delete(t.session_log).where(entry.session_id == session_id)),
                Write(sa.delete(t.sessions).where(t.sessions.c.session_id == session_id)),
            )
            await asyncio.sleep(BREATH_S)
        return len(session_ids)
