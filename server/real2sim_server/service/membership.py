"""A worker among those that share its store: it tells that it lives, and leaves the sessions that
others have taken over while it did not."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

import structlog

from .accounts import Accounts
from .sessions import Sessions
from .storage.leases import Leases
from .storage.store import StoreError

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
