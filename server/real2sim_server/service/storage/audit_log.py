"""Who did what, in the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import sqlalchemy as sa

from ..clock import now_us
from . import tables as t
from .store import Store, Write

RETENTION_US = 365 * 24 * 3600 * 1_000_000
"""For which entries are kept."""


@dataclass(frozen=True)
class AuditEntry:
    """A request that changed something, or was refused for its token or role.

    Attributes:
        account: name of the token; empty where there was none that is valid.
        client: address that it came from.
        worker_id: that answered.
        method, path: of the request.
        status: of the answer.
        request_id: as in the answer and the log.
        at_us: when, wall clock [us].
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
    """Entries beyond the life of a process.

    Args:
        store: open while this is used.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    async def add(self, entries: Sequence[AuditEntry]) -> None:
        """Put entries on record, and forget those of more than a year ago."""
        old = t.audit.c.at_us < now_us() - RETENTION_US
        rows = [asdict(entry) for entry in entries]
        await self._store.write(
            Write(sa.insert(t.audit), rows), Write(sa.delete(t.audit).where(old))
        )

    async def newest(self, *, account: str | None, limit: int) -> list[AuditEntry]:
        """Entries, newest first.

        Args:
            account: only of this token; None for all.
            limit: so many at most.
        """
        a = t.audit.c
        query = sa.select(*(a[name] for name in AuditEntry.__dataclass_fields__))
        if account is not None:
            query = query.where(a.account == account)
        rows = await self._store.read(query.order_by(a.at_us.desc(), a.entry.desc()).limit(limit))
        return [AuditEntry(**row) for row in rows]
