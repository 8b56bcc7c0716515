"""Maintenance of a worker: removes leftovers of killed runs and data above the limits."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa
import structlog

from .._files import sweep_leftovers
from ..settings import Settings
from .clock import now_us
from .jobs import Jobs
from .sessions import Sessions
from .sessions.shared_memory import sweep_segments
from .storage import schema as t
from .storage.backup import RESTORING
from .storage.connection import StoreError
from .storage.store import Claim, Store, Write

# --- Retention -----------------------------------------------------------------------------------

# Scenarios stay until a client deletes them. Rows are deleted in small batches with pauses; a step
# waits for at most one batch.

DAY_US = 86_400 * 1_000_000
PIECE_ROWS = 1000
PIECE_PAGES = 256
SESSIONS_AT_ONCE = 8
BREATH_S = 0.01
"""Pause between batches [s]."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class RetentionLimits:
    """Limits of a store.

    Attributes:
        session_days: days after which an ended session is deleted, and an unused one is ended.
        max_bytes: size above which the oldest ended sessions are deleted earlier.
    """

    session_days: float
    max_bytes: int


class Retention:
    """Limits the store of a worker.

    Args:
        store: an open store.
        limits: the limits.
        worker_id: worker whose unused sessions are ended.
    """

    def __init__(self, store: Store, limits: RetentionLimits, *, worker_id: str) -> None:
        self._store = store
        self._limits = limits
        self._worker_id = worker_id

    async def tidy(self, *, in_use: Collection[str] = ()) -> int:
        """Delete data beyond the limits; returns the number of deleted sessions.

        Args:
            in_use: open sessions in memory.

        Raises:
            StoreTroubleError: the store fails; the next run continues.
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
        """End the sessions unused since ``cutoff_us``."""
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
                reason = f"unused for {self._limits.session_days:g} days"
                await self._store.close_session(Claim(**row), reason=reason)

    async def _ended(self, *, before_us: int | None = None) -> Sequence[str]:
        """Some ended sessions, oldest end first."""
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


PERIOD_S = 3600.0
UPLOADS = ".upload-"
OTHERS_UNUSED_S = 3600.0
"""Age after which another process's unfinished files count as abandoned [s]."""


class Maintenance:
    """Cleans up the folders and the store of a worker, at startup and every hour.

    Args:
        settings: folders and limits.
        store: an open store.
        jobs: jobs of the worker; old ones are deleted with their files.
        sessions: sessions in memory, which are not ended.
    """

    def __init__(self, settings: Settings, store: Store, jobs: Jobs, sessions: Sessions) -> None:
        self._settings = settings
        self._jobs = jobs
        self._sessions = sessions
        limits = RetentionLimits(settings.session_retention_days, settings.store_max_bytes)
        self._retention = Retention(store, limits, worker_id=settings.worker_id)

    async def run(self) -> None:
        """Run maintenance now and every hour, until cancelled."""
        while True:
            try:
                await self.once()
            except StoreError as error:
                log.warning("maintenance put off", reason=str(error))
            except Exception:
                log.exception("maintenance failed")
            await asyncio.sleep(PERIOD_S)

    async def once(self) -> None:
        """Run all tasks. Raises StoreTroubleError if the store fails."""
        await asyncio.to_thread(self.sweep)
        await self._retention.tidy(in_use={session.session_id for session in self._sessions})
        days = self._settings.job_retention_days
        if forgotten := await self._jobs.forget_before(now_us() - round(days * DAY_US)):
            log.info("ended jobs forgotten", jobs=forgotten)

    def sweep(self, *, at_start: bool = False) -> None:
        """Remove unfinished files of killed runs.

        Args:
            at_start: whether the worker is starting; all unfinished files in its own folders are
                then abandoned, regardless of age.
        """
        settings = self._settings
        removed: list[Path] = []
        for folder in (settings.assets_path, settings.scenes_path):
            # No other worker uses the state folder.
            own = folder.resolve().is_relative_to(settings.data_dir.resolve())
            unused_s = 0.0 if own and at_start else OTHERS_UNUSED_S
            removed += sweep_leftovers(folder, unused_s=unused_s, prefix=UPLOADS)
            removed += sweep_leftovers(folder, unused_s=OTHERS_UNUSED_S)
        unused_s = 0.0 if at_start else OTHERS_UNUSED_S
        removed += sweep_leftovers(settings.data_dir, unused_s=unused_s)
        removed += sweep_leftovers(settings.data_dir, unused_s=unused_s, prefix=RESTORING)
        removed += sweep_segments()
        if removed:
            names = [path.name for path in removed[:10]]
            log.warning("leftovers removed", count=len(removed), names=names)
