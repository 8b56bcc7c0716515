"""Word from one worker to the others that something has changed in the store, by PostgreSQL's
LISTEN and NOTIFY: who looks every second anyway looks at once.

Word may be lost, as when the connection breaks, and SQLite has none: whoever waits for it waits for
a bounded time, and looks then.
"""

from __future__ import annotations

import asyncio
import contextlib
import select
import threading
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Literal

import sqlalchemy as sa
import structlog
from sqlalchemy.engine import make_url

from .connection import native_connection
from .database import Write

Topic = Literal["jobs", "bundles"]
"""What has changed."""

CHANNEL = "real2sim"
BEAT_S = 1.0
"""Between questions whether the server is still there, and for word that the driver has kept."""
RETRY_S = 1.0
"""Between attempts to connect."""
PAUSE_S = 0.05
"""From word to the look that it causes, in which more may come."""

log = structlog.get_logger(__name__)


def notice(topic: Topic, *, on_server: bool) -> list[Write]:
    """What lets other workers know, once the transaction that it is part of is committed."""
    if not on_server:
        return []
    return [Write(sa.text("SELECT pg_notify(:channel, :topic)").bindparams(**_of(topic)))]


def _of(topic: str) -> dict[str, str]:
    return {"channel": CHANNEL, "topic": topic}


class Notices:
    """Hears what other workers say. Belongs to the event loop; it listens on a thread of its own.

    Args:
        url: of the store.
        timeout_s: of an answer of its server [s].
    """

    def __init__(self, url: str, *, timeout_s: float) -> None:
        self._url = make_url(url)
        self._timeout_s = timeout_s
        self._counts: Counter[str] = Counter()
        self._changed = asyncio.Event()
        self._stop = threading.Event()

    @property
    def can_hear(self) -> bool:
        """Whether the store has word to give."""
        return self._url.get_backend_name() == "postgresql" and (
            self._url.get_driver_name() == "pg8000"
        )

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Listens for the length of the block, where there is something to hear."""
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
        """A function that waits for word about ``topic`` since its last call, or some seconds."""
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
                # The store tells of its trouble itself; meanwhile others look now and then.
                log.debug("not listening", reason=str(error))
            self._stop.wait(RETRY_S)

    def _listen_once(self, loop: asyncio.AbstractEventLoop) -> None:
        connection, socket = native_connection(self._url, self._timeout_s)
        try:
            connection.run(f"LISTEN {CHANNEL}")
            # What was said before may have been missed.
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
