"""Who did what: every request that changes something, and every one that was refused for its role
or token, beside the requests: none of them waits for it."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator

import structlog

from .storage.audit_log import AuditEntry, AuditLog
from .storage.store import StoreError

FLUSH_S = 1.0
"""Between writes; the last second is lost with a worker that is killed."""
MOST_WAITING = 10_000
"""Entries that wait while the store is in trouble; older ones are dropped then."""

log = structlog.get_logger(__name__)


class Audit:
    """Gathers entries and puts them on record. Belongs to the event loop.

    Args:
        audit_log: keeps them.
    """

    def __init__(self, audit_log: AuditLog) -> None:
        self._log = audit_log
        self._waiting: deque[AuditEntry] = deque(maxlen=MOST_WAITING)

    def note(self, entry: AuditEntry) -> None:
        """Remember an entry; it is on record a second later."""
        if len(self._waiting) == MOST_WAITING:
            log.error("audit entry dropped", entry=vars(self._waiting[0]))
        self._waiting.append(entry)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Writes for the length of the block, and what is left at its end."""
        writing = asyncio.create_task(self._write_for_ever(), name="audit")
        try:
            yield
        finally:
            writing.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await writing
            with contextlib.suppress(StoreError):
                await self.flush()

    async def flush(self) -> None:
        """Write what waits. Raises StoreError: it waits on."""
        entries = list(self._waiting)
        if not entries:
            return
        await self._log.add(entries)
        for _ in range(min(len(entries), len(self._waiting))):
            self._waiting.popleft()

    async def _write_for_ever(self) -> None:
        while True:
            await asyncio.sleep(FLUSH_S)
            try:
                await self.flush()
            except StoreError:
                continue  # it tells of its trouble itself
            except Exception:
                log.exception("audit failed")
