"""Leases of workers on sessions, and notifications between workers.

A worker renews its lease every few seconds. If a lease expires, other workers may take over its
sessions. All times are from one clock: that of the database server, or of the machine with the
database file.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import select
import threading
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import sqlalchemy as sa
import structlog
from sqlalchemy.engine import make_url

from ..clock import now_us
from . import schema as t
from .connection import native_connection
from .database import Write
from .schema import SessionRow
from .store import Store


@dataclass(frozen=True)
class WorkerRow:
    """A worker that shares the store.

    Attributes:
        worker_id: its name.
        alive: whether its lease is valid.
        document: its last reported status.
    """

    worker_id: str
    alive: bool
    document: Mapping[str, Any]


class Leases:
    """The lease of a worker, and takeovers of expired ones.

    Args:
        store: an open store.
        worker_id: id of this worker.
        seconds: duration of a lease.

    Attributes:
        worker_id: id of this worker.
    """

    def __init__(self, store: Store, worker_id: str, *, seconds: float) -> None:
        self._store = store
        self.worker_id = worker_id
        self._seconds = seconds

    async def renew(self, document: Mapping[str, Any]) -> None:
        """Renew the lease from now.

        Args:
            document: status of the worker for the fleet, JSON values.
        """
        await self._promise(self._seconds, document)

    async def give_up(self, document: Mapping[str, Any]) -> None:
        """End the lease; other workers may take over the sessions immediately."""
        await self._promise(0.0, document)

    async def take_over(self, session_id: str) -> SessionRow | None:
        """Claim an open session of this worker, or of a worker with an expired lease; None if the
        session is not open or another worker has it."""
        s = t.sessions.c
        is_free = (s.worker_id == self.worker_id) | ~is_alive(s.worker_id, self._store)
        claimed = sa.update(t.sessions).where((s.session_id == session_id) & s.closed_us.is_(None))
        claimed = claimed.where(is_free).values(worker_id=self.worker_id, epoch=s.epoch + 1)
        (count,) = await self._store.write(Write(claimed))
        row = await self._store.session(session_id)
        return row if count and row is not None and row.worker_id == self.worker_id else None

    async def epochs(self, session_ids: Collection[str]) -> dict[str, int]:
        """Epochs of this worker's sessions among ``session_ids``, by id."""
        s = t.sessions.c
        mine = (s.worker_id == self.worker_id) & s.session_id.in_(session_ids)
        rows = await self._store.read(sa.select(s.session_id, s.epoch).where(mine))
        return {row["session_id"]: row["epoch"] for row in rows}

    async def workers(self) -> list[WorkerRow]:
        """All workers that have ever shared the store, by name."""
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
            # Leases need not be durable: they are useless after a crash of the machine.
            (count,) = self._store.database.execute([renewed], promised=False)
            if not count:
                self._store.database.execute([first], promised=False)

        await self._store.database.on_thread(promise)


def is_alive(worker_id: sa.ColumnElement[str], store: Store) -> sa.ColumnElement[bool]:
    """SQL condition: whether the worker named by a column has a valid lease."""
    w = t.workers.c
    return sa.exists().where((w.worker_id == worker_id) & (w.lease_until_us > clock_of(store)))


def clock_of(store: Store) -> sa.ColumnElement[int]:
    """SQL expression: the common wall clock [us]."""
    if store.database.is_server:
        seconds = sa.func.extract("epoch", sa.func.clock_timestamp())
        return sa.cast(seconds * 1_000_000, sa.BigInteger)
    return sa.literal(now_us(), sa.BigInteger)


# --- Notices -------------------------------------------------------------------------------------

# PostgreSQL's LISTEN and NOTIFY notify other workers of a change immediately. Notifications may be
# lost and SQLite has none, so every wait has a timeout.

Topic = Literal["jobs", "bundles"]
"""Kind of change."""

CHANNEL = "real2sim"
BEAT_S = 1.0
"""Interval of server health checks, which also receive notifications buffered by the driver [s]."""
RETRY_S = 1.0
"""Interval of connection attempts [s]."""
PAUSE_S = 0.05
"""Delay from a notification to the resulting query, to collect more notifications [s]."""

log = structlog.get_logger(__name__)


def notice(topic: Topic, *, on_server: bool) -> list[Write]:
    """Statements that notify other workers when their transaction is committed."""
    if not on_server:
        return []
    return [Write(sa.text("SELECT pg_notify(:channel, :topic)").bindparams(**_of(topic)))]


def _of(topic: str) -> dict[str, str]:
    return {"channel": CHANNEL, "topic": topic}


class Notices:
    """Receives notifications of other workers on a separate thread. For use on the event loop.

    Args:
        url: URL of the store.
        timeout_s: timeout of the server's answers [s].
    """

    def __init__(self, url: str, *, timeout_s: float) -> None:
        self._url = make_url(url)
        self._timeout_s = timeout_s
        self._counts: Counter[str] = Counter()
        self._changed = asyncio.Event()
        self._stop = threading.Event()

    @property
    def can_hear(self) -> bool:
        """Whether the database supports notifications."""
        return self._url.get_backend_name() == "postgresql" and (
            self._url.get_driver_name() == "pg8000"
        )

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Listen during the block, if the database supports it."""
        if not self.can_hear:
            yield
            return
        loop = asyncio.get_running_loop()
        thread = threading.Thread(target=self._listen, args=(loop,), name="notices", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            await asyncio.to_thread(thread.join)

    def listener(self, topic: Topic) -> Callable[[float], Awaitable[None]]:
        """A function that waits, with a timeout, for a notification about ``topic`` since its last
        call."""
        seen = self._counts[topic]

        async def wait(seconds: float) -> None:
            nonlocal seen
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    while self._counts[topic] == seen:
                        await self._changed.wait()
                    await asyncio.sleep(PAUSE_S)
            seen = self._counts[topic]

        return wait

    # --- inside -----------------------------------------------------------------------------

    def _heard(self, topics: Counter[str]) -> None:
        self._counts.update(topics)
        waiting, self._changed = self._changed, asyncio.Event()
        waiting.set()

    def _listen(self, loop: asyncio.AbstractEventLoop) -> None:
        while not self._stop.is_set():
            try:
                self._listen_once(loop)
            except Exception as error:
                # The store logs its own failures; until it recovers, waiters poll.
                log.debug("not listening", reason=str(error))
            self._stop.wait(RETRY_S)

    def _listen_once(self, loop: asyncio.AbstractEventLoop) -> None:
        connection, socket = native_connection(self._url, self._timeout_s)
        try:
            connection.run(f"LISTEN {CHANNEL}")
            # Earlier notifications may have been missed.
            heard = Counter({"jobs": 1, "bundles": 1})
            while not self._stop.is_set():
                if heard:
                    loop.call_soon_threadsafe(self._heard, heard)
                select.select([socket], [], [], BEAT_S)
                connection.run("SELECT 1")
                heard = Counter(topic for _, _, topic in connection.notifications)
                connection.notifications.clear()
        finally:
            with contextlib.suppress(Exception):
                connection.close()
            socket.close()
