"""Which worker has which session: workers promise again and again to live for some seconds more;
the sessions of one whose promise has run out may be taken over.

All compare times by one clock: that of the database server, or of the machine that has the file.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ..clock import now_us
from . import tables as t
from .rows import SessionRow
from .store import Store, Write


@dataclass(frozen=True)
class WorkerRow:
    """A worker that shares the store.

    Attributes:
        worker_id: its name.
        alive: whether its lease still runs.
        document: what it last said about itself.
    """

    worker_id: str
    alive: bool
    document: Mapping[str, Any]


class Leases:
    """Promises of a worker, and what comes of those that others do not keep.

    Args:
        store: open while this is used.
        worker_id: whose promises these are.
        seconds: for which each holds.

    Attributes:
        worker_id: whose promises these are.
    """

    def __init__(self, store: Store, worker_id: str, *, seconds: float) -> None:
        self._store = store
        self.worker_id = worker_id
        self._seconds = seconds

    async def renew(self, document: Mapping[str, Any]) -> None:
        """Promise to be alive for so long from now on.

        Args:
            document: what the fleet is told about the worker, JSON values.
        """
        await self._promise(self._seconds, document)

    async def give_up(self, document: Mapping[str, Any]) -> None:
        """Take the promise back: others may have the sessions at once."""
        await self._promise(0.0, document)

    async def take_over(self, session_id: str) -> SessionRow | None:
        """Claim an open session that is this worker's, or whose worker has not kept its promise;
        None where there is none, or another one has it."""
        s = t.sessions.c
        is_free = (s.worker_id == self.worker_id) | ~is_alive(s.worker_id, self._store)
        claimed = sa.update(t.sessions).where((s.session_id == session_id) & s.closed_us.is_(None))
        claimed = claimed.where(is_free).values(worker_id=self.worker_id, epoch=s.epoch + 1)
        (count,) = await self._store.write(Write(claimed))
        row = await self._store.session(session_id)
        return row if count and row is not None and row.worker_id == self.worker_id else None

    async def epochs(self, session_ids: Collection[str]) -> dict[str, int]:
        """Epochs of those of the sessions that this worker has, by their ids."""
        s = t.sessions.c
        mine = (s.worker_id == self.worker_id) & s.session_id.in_(session_ids)
        rows = await self._store.read(sa.select(s.session_id, s.epoch).where(mine))
        return {row["session_id"]: row["epoch"] for row in rows}

    async def workers(self) -> list[WorkerRow]:
        """All workers that ever shared the store, by name."""
        w = t.workers.c
        alive = (w.lease_until_us > clock_of(self._store)).label("alive")
        query = sa.select(w.worker_id, alive, w.document).order_by(w.worker_id)
        return [
            WorkerRow(row["worker_id"], bool(row["alive"]), json.loads(row["document"]))
            for row in await self._store.read(query)
        ]

    async def _promise(self, seconds: float, document: Mapping[str, Any]) -> None:
        text = json.dumps(document, allow_nan=False)
        until = clock_of(self._store) + round(seconds * 1e6)
        mine = t.workers.c.worker_id == self.worker_id
        values = {"lease_until_us": until, "document": text}
        renewed = Write(sa.update(t.workers).where(mine).values(values))
        first = Write(sa.insert(t.workers).values(worker_id=self.worker_id, **values))

        def promise() -> None:
            # It is no use after the machine has gone down: nothing has to reach the disk.
            (count,) = self._store.database.execute([renewed], promised=False)
            if not count:
                self._store.database.execute([first], promised=False)

        await self._store.database.on_thread(promise)


def is_alive(worker_id: sa.ColumnElement[str], store: Store) -> sa.ColumnElement[bool]:
    """Whether the worker that a column names keeps its promise, as a condition."""
    w = t.workers.c
    return sa.exists().where((w.worker_id == worker_id) & (w.lease_until_us > clock_of(store)))


def clock_of(store: Store) -> sa.ColumnElement[int]:
    """Wall clock that all compare times by [us], as an expression."""
    if store.database.is_server:
        seconds = sa.func.extract("epoch", sa.func.clock_timestamp())
        return sa.cast(seconds * 1_000_000, sa.BigInteger)
    return sa.literal(now_us(), sa.BigInteger)
