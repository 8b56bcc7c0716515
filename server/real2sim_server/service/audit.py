"""The audit log: every request that changes something or is refused for its token or role.

Entries are written in the background; no request waits for them.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Sequence
from dataclasses import asdict, dataclass

import sqlalchemy as sa
import structlog

from .clock import now_us
from .storage import schema as t
from .storage.store import Store, StoreError, Write

# --- The log in the store ------------------------------------------------------------------------

RETENTION_US = 365 * 24 * 3600 * 1_000_000
"""Retention time of entries [us]."""


@dataclass(frozen=True)
class AuditEntry:
    """A request that changed something, or was refused for its token or role.

    Attributes:
        account: name of the token; empty without a valid one.
        client: address of the client.
        worker_id: worker that answered.
        method, path: method and path of the request.
        status: status of the reply.
        request_id: request id in the reply and the log.
        at_us: wall clock [us].
    """

    account: str
    client: str
    worker_id: str
    method: str
    path: str
    status: int
    request_id: str
    at_us: int


class AuditLog:
    """Stored entries.

    Args:
        store: an open store.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    async def add(self, entries: Sequence[AuditEntry]) -> None:
        """Store entries, and delete those older than a year."""
        old = t.audit.c.at_us < now_us() - RETENTION_US
        rows = [asdict(entry) for entry in entries]
        await self._store.write(
            Write(sa.insert(t.audit), rows), Write(sa.delete(t.audit).where(old))
        )

    async def newest(self, *, account: str | None, limit: int) -> list[AuditEntry]:
        """Entries, newest first.

        Args:
            account: only entries of this token; None for all.
            limit: maximum number.
        """
        a = t.audit.c
        query = sa.select(*(a[name] for name in AuditEntry.__dataclass_fields__))
        if account is not None:
            query = query.where(a.account == account)
        rows = await self._store.read(query.order_by(a.at_us.desc(), a.entry.desc()).limit(limit))
        return [AuditEntry(**row) for row in rows]


FLUSH_S = 1.0
"""Interval of writes [s]; a killed worker loses the last one."""
MAX_WAITING = 10_000
"""Maximum number of pending entries while the store fails; older ones are dropped."""

log = structlog.get_logger(__name__)


class Audit:
    """Collects entries and stores them, for use on the event loop.

    Args:
        audit_log: stores the entries.
    """

    def __init__(self, audit_log: AuditLog) -> None:
        self._log = audit_log
        self._waiting: deque[AuditEntry] = deque(maxlen=MAX_WAITING)

    def note(self, entry: AuditEntry) -> None:
        """Queue an entry; it is stored within a second."""
        if len(self._waiting) == MAX_WAITING:
            log.error("audit entry dropped", entry=vars(self._waiting[0]))
        self._waiting.append(entry)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Write entries during the block, and the remaining ones at its end."""
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
        """Write pending entries. Raises StoreError; the entries then stay pending."""
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
                continue  # the store logs its own errors
            except Exception:
                log.exception("audit failed")
