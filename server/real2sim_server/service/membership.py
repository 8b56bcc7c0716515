"""A worker within a fleet: its lease, the scenes it loads ahead, its reports to the proxy."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import structlog

from .accounts import Accounts
from .http.problems import ServiceError
from .library.scenes import SceneCache
from .sessions import Sessions
from .storage.errors import StoreError
from .storage.fleet import Leases, WorkerRow

RENEWALS = 4
"""Of each lease, so that some may be late."""

log = structlog.get_logger(__name__)


class Membership:
    """Keeps a worker's lease for as long as it runs.

    Args:
        leases: of the worker.
        sessions: that it has by them.
        seconds: of a lease.
        document: what the fleet is told about the worker, made anew for each renewal.
        accounts: told what others say of who has how much.
    """

    def __init__(
        self,
        leases: Leases,
        sessions: Sessions,
        *,
        seconds: float,
        document: Callable[[], Mapping[str, Any]],
        accounts: Accounts,
    ) -> None:
        self._leases = leases
        self._sessions = sessions
        self._seconds = seconds
        self._document = document
        self._accounts = accounts
        self._renewed = 0.0
        self._left = False

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """The lease holds for the length of the block, and ends with it.

        Raises:
            StoreError: the first promise cannot be made.
        """
        await self._renew()
        renewing = asyncio.create_task(self._renew_for_ever(), name="lease")
        try:
            yield
        finally:
            renewing.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await renewing
            if not self._left:
                await self.leave()

    async def tell(self) -> None:
        """Let others know at once what has become of the worker."""
        with contextlib.suppress(StoreError):
            await self._renew()

    async def leave(self) -> None:
        """Keep no lease any more: others may have the sessions at once."""
        self._left = True
        with contextlib.suppress(StoreError):
            await self._leases.give_up(self._document())

    async def _renew_for_ever(self) -> None:
        while not self._left:
            await asyncio.sleep(self._seconds / RENEWALS)
            try:
                await self._renew()
            except StoreError:
                # The store tells of its trouble itself; without it others cannot take over either.
                continue
            except Exception:
                # Whatever it was: without its lease the worker would lose its sessions.
                log.exception("renewing the lease failed")

    async def _renew(self) -> None:
        if self._left:
            return
        asked = time.monotonic()
        await self._leases.renew(self._document())
        await self._hear_of_others()
        lapsed = self._renewed and time.monotonic() - self._renewed > self._seconds
        self._renewed = asked
        if lapsed:
            log.warning("the lease had run out", seconds=self._seconds)
            await self._sessions.let_go_of_lost()

    async def _hear_of_others(self) -> None:
        """What they say of who has how much, where that is limited."""
        if self._accounts.counts:
            rows = await self._leases.workers()
            others = [w for w in rows if w.alive and w.worker_id != self._leases.worker_id]
            self._accounts.take_word(w.document.get("held", {}) for w in others)


# --- Agent check ---------------------------------------------------------------------------------

# Reports in the words of HAProxy's ``agent-check`` how much new work the worker takes. A draining
# worker keeps its sessions and gets no new ones. The weight does not follow the load, since that
# would move scenes between workers; the proxy's bounded hashing balances the load.


@dataclass(frozen=True)
class Willingness:
    """What a worker takes.

    Attributes:
        ready: whether new work is welcome at all.
        full: whether as many sessions are open as may be.
        handed_over: whether its sessions are others' by now: nothing may be sent here any more.
    """

    ready: bool
    full: bool
    handed_over: bool


class Agent:
    """Answers every connection with one line, and closes it.

    Args:
        willingness: of the worker, asked for each answer.
        weight: of the worker among others, in per cent of what its proxy gives it.
    """

    def __init__(self, willingness: Callable[[], Willingness], *, weight: int) -> None:
        self._willingness = willingness
        self._weight = weight

    def word(self) -> str:
        """The line: ``up ready 100%``, ``drain``, or ``down``."""
        found = self._willingness()
        if found.handed_over:
            return "down"
        if not found.ready or found.full:
            return "up drain"
        return f"up ready {self._weight}%"

    @contextlib.asynccontextmanager
    async def running(self, host: str, port: int) -> AsyncIterator[int]:
        """Listens for the length of the block.

        Args:
            host: address to listen on.
            port: 0 takes a free one.

        Yields:
            The port.

        Raises:
            OSError: the address is taken, or none of this machine.
        """
        server = await asyncio.start_server(self._answer, host, port)
        try:
            yield server.sockets[0].getsockname()[1]
        finally:
            server.close()
            await server.wait_closed()

    async def _answer(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            writer.write(f"{self.word()}\n".encode())
            await writer.drain()
            writer.close()
            await writer.wait_closed()


# --- Prewarming ----------------------------------------------------------------------------------

# The proxy sends new sessions to the worker that has their scene, until that one has half as many
# again as the others. The next worker then already has the scene in memory.

LOOK_S = 5.0
"""Between looks at what the fleet drives in."""


class Prewarming:
    """Loads what other workers are busy with, where this one is next in turn.

    Args:
        leases: tell of the workers.
        scene_cache: gets the scenes; they leave it again when memory is needed.
        worker_id: of this one.
        hot: sessions in a scene, over all workers, from which on two of them have it.
    """

    def __init__(
        self, leases: Leases, scene_cache: SceneCache, *, worker_id: str, hot: int
    ) -> None:
        self._leases = leases
        self._scene_cache = scene_cache
        self._worker_id = worker_id
        self._hot = hot

    async def run(self) -> None:
        """Look again and again, for ever."""
        while self._hot:
            await asyncio.sleep(LOOK_S)
            try:
                await self.look()
            except StoreError:
                continue  # it tells of its trouble itself
            except ServiceError as error:
                log.info("scene not loaded ahead", reason=str(error))

    async def look(self) -> None:
        """Load the scenes that are this worker's to load.

        Raises:
            StoreError: of the database.
            ServiceError: a scene cannot be loaded.
        """
        for scene in loads_of(self._worker_id, await self._leases.workers(), hot=self._hot):
            log.info("scene loaded ahead", scene=scene)
            await self._scene_cache.get(scene)


def loads_of(worker_id: str, workers: Sequence[WorkerRow], *, hot: int) -> list[str]:
    """Hot scenes that one worker alone has, and that ``worker_id`` is the one to load.

    All workers find the same, from what each has told of itself: of those without the scene the
    first in an order that differs from scene to scene.
    """
    living = {w.worker_id: w.document for w in workers if w.alive and takes_work(w.document)}
    driven: Counter[str] = Counter()
    for document in living.values():
        driven.update(document.get("scene_sessions", {}))
    found = []
    for scene in sorted(scene for scene, many in driven.items() if many >= hot):
        without = [name for name, about in living.items() if scene not in about.get("scenes", ())]
        if len(living) - len(without) == 1 and without:
            first = min(without, key=lambda name: _order(scene, name))
            found += [scene] * (first == worker_id)
    return found


def _order(scene: str, worker_id: str) -> bytes:
    return hashlib.sha256(f"{scene} {worker_id}".encode()).digest()


def takes_work(document: Mapping[str, Any]) -> bool:
    """Whether a worker that tells this of itself takes new sessions and jobs."""
    return bool(document.get("ready")) and not document.get("draining")
