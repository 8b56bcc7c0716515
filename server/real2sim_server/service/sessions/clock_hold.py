"""When the clock of a session may move: at once, at a pace, for some steps, or not."""

from __future__ import annotations

import asyncio
import contextlib
import math

from .. import clock


class ClockHold:
    """Lets actions pass, all of them or so many, at once or at a pace; the others wait. Belongs to
    the event loop."""

    def __init__(self) -> None:
        self._steps: int | None = None
        self._pace: float | None = None
        self._next_s = 0.0
        self._changed = asyncio.Event()

    @property
    def held(self) -> bool:
        """Whether the next action has to wait until somebody lets it go."""
        return self._steps == 0

    @property
    def free(self) -> bool:
        """Whether actions need not ask before they move the clock."""
        return self._steps is None and self._pace is None

    @property
    def wait_s(self) -> float:
        """How long the next action has to wait from now [s]."""
        if self.held:
            return math.inf
        return 0.0 if self._pace is None else max(0.0, self._next_s - clock.monotonic())

    def release(self, *, pace: float | None = None) -> None:
        """All actions pass; with a pace, so many simulated seconds take a second."""
        self._steps, self._pace = None, pace
        self._changed.set()

    def hold(self, *, after: int = 0) -> None:
        """So many more actions pass; then they wait."""
        self._steps = after
        self._changed.set()

    def take_step(self, dt_us: int) -> None:
        """An action passes, for a step so long."""
        if self._steps:
            self._steps -= 1
        if self._pace is not None:
            now = clock.monotonic()
            self._next_s = max(self._next_s, now) + dt_us * 1e-6 / self._pace

    async def wait(self, seconds: float) -> None:
        """Wait for a change, so long at most."""
        self._changed.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._changed.wait()
