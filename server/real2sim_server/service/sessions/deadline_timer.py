"""Deadlines of plans, and the wall-clock time of episodes."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

import structlog
from prometheus_client import Counter

from .. import clock
from .session import Session
from .step import Stepper
from .wire import EncodedMessage

log = structlog.get_logger(__name__)

Send = Callable[[EncodedMessage], Awaitable[None]]


class DeadlineTimer:
    """Waits for the action that is due, on behalf of one connected controller.

    The clock of a deadline runs from the moment the observation has been sent until the action
    has arrived; neither computing nor a lost connection counts. Nothing here holds up another
    session: what a fallback computes waits in the same queue as any step.

    Args:
        session: whose controller is connected.
        stepper: makes the fallback's step.
        send: sends an observation that no action has led to.
        missed: counts deadlines that have passed.
    """

    def __init__(self, session: Session, stepper: Stepper, send: Send, *, missed: Counter) -> None:
        self._session = session
        self._stepper = stepper
        self._send = send
        self._missed = missed
        self._waiting: asyncio.Task[None] | None = None
        self._sent_at = clock.monotonic()

    def start(self) -> None:
        """An observation has been sent."""
        self._sent_at = clock.monotonic()
        self.cancel()
        session = self._session
        if session.world is None or session.world.over:
            return
        deadline, cap = session.spec.deadline_ms, session.expires_at
        if (deadline is not None and not session.late) or cap is not None:
            self._waiting = asyncio.create_task(self._wait(session.world.steps))

    def cancel(self) -> None:
        """The action has arrived, or the controller has left."""
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    @property
    def waiting(self) -> bool:
        """Whether an action is being waited for."""
        return self._waiting is not None and not self._waiting.done()

    @property
    def waited_us(self) -> int:
        """Time since the newest observation was sent [us]."""
        return int((clock.monotonic() - self._sent_at) * 1e6)

    async def _wait(self, step: int) -> None:
        try:
            while (until := self._next(step)) is not None:
                await clock.sleep_until(until)
                # The fallback itself must not be broken off half way by an action that arrives.
                await asyncio.shield(asyncio.ensure_future(self._expire(step)))
                step = self._session.lockstep.step or 0
        except Exception:
            log.exception("fallback failed", session_id=self._session.session_id)

    def _next(self, step: int) -> float | None:
        """Monotonic time of the next deadline; None where there is none."""
        session = self._session
        if session.world is None or session.world.over or session.lockstep.step != step:
            return None
        times = [] if session.expires_at is None else [session.expires_at]
        if session.spec.deadline_ms is not None and not session.late:
            times.append(self._sent_at + session.spec.deadline_ms * 1e-3)
        return min(times, default=None)

    async def _expire(self, step: int) -> None:
        session = self._session
        async with session.lock:
            if session.closed is not None or session.lockstep.step != step:
                return
            if session.world is None or session.world.over:
                return
            if not session.expired:
                self._missed.inc()
            if session.expired:
                message = await self._stepper.stop(session, "wall_clock")
            elif session.spec.on_timeout == "pause":
                session.late = True
                return
            elif session.spec.on_timeout == "fail":
                message = await self._stepper.stop(session, "deadline")
            else:
                message = await self._stepper.step_without_action(session)
            self._sent_at = clock.monotonic()
        with contextlib.suppress(Exception):
            await self._send(message)
        self._sent_at = clock.monotonic()
