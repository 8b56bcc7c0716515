"""A clock for workers that only advances when a test moves it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator

import pytest

from real2sim_server.service import clock
from tests.waiting import wait_until

SOON_S = 1.0
"""Tests wait for sleepers due within this time [s]. Periodic work of a worker is due later."""


class ManualClock:
    """Replaces the worker's monotonic time while a test runs.

    Deadlines, wall-clock limits, idle times, rates and engine time only pass when the test calls
    :meth:`advance` or :meth:`expire_next`. They do not depend on the speed of the machine.
    """

    def __init__(self) -> None:
        self._now = clock.monotonic()
        self._lock = threading.Lock()
        self._sleepers: dict[asyncio.Future[None], float] = {}

    def monotonic(self) -> float:
        return self._now

    async def sleep_until(self, at: float) -> None:
        due: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        with self._lock:
            if at <= self._now:
                due.set_result(None)
            else:
                self._sleepers[due] = at
        try:
            await due
        finally:
            with self._lock:
                self._sleepers.pop(due, None)

    def advance(self, seconds: float) -> None:
        """Advance the clock and wake everything that is due."""
        with self._lock:
            self._now += seconds
            for future, at in list(self._sleepers.items()):
                if at <= self._now:
                    del self._sleepers[future]
                    future.get_loop().call_soon_threadsafe(_wake, future)

    def wait_for_sleeper(self) -> float:
        """Wait until something is due soon. Returns the remaining time [s]."""
        return wait_until(self._next_due, "something that waits for the clock")

    def expire_next(self) -> None:
        """Wait until something is due soon, then advance to that moment."""
        self.advance(self.wait_for_sleeper())

    def release(self) -> None:
        """Wake all sleepers, so that workers that outlive the test continue."""
        with self._lock:
            for future in self._sleepers:
                future.get_loop().call_soon_threadsafe(_wake, future)
            self._sleepers.clear()

    @property
    def anything_due(self) -> bool:
        """Whether something is due soon."""
        return self._next_due() is not None

    def _next_due(self) -> float | None:
        with self._lock:
            left = [at - self._now for at in self._sleepers.values()]
        return min((s for s in left if s <= SOON_S), default=None)


def _wake(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


@pytest.fixture
def manual_clock() -> Iterator[ManualClock]:
    """Manual clock for all workers of this process."""
    manual = ManualClock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clock, "monotonic", manual.monotonic)
        patch.setattr(clock, "sleep_until", manual.sleep_until)
        yield manual
    manual.release()
