"""Steps of a controller that begin in the very call that has read their action, and end in the one
that has their result: no task is woken for either.

That is for the action that is due in a session without sensors, from a client whom no limit holds
up. Whatever else comes, or has to be refused, goes the ordinary way (`connection`).
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from contextvars import copy_context
from functools import partial
from typing import TypeVar

from starlette.websockets import WebSocketDisconnect

from real2sim_proto.drive import Action

from ..accounts import ACCOUNT
from ..http.metrics import Metrics
from ..http.problems import service_error
from .deadline_timer import DeadlineTimer
from .handshake import SMALL_BYTES, error_message
from .messages import action_in
from .observation import EncodedObservation
from .segment import SLOTS
from .session import Session
from .step import BrokenStep, DueAction, Stepper
from .wire import EncodedMessage

T = TypeVar("T")

Write = Callable[[int, EncodedMessage], bool]
"""Writes an answer to the message of an id if nothing has to be waited for; whether it did."""
Send = Callable[[EncodedMessage, int], Awaitable[None]]


class StepsAtOnce:
    """Of one connection; made by the task that serves it, in whose context they run.

    Args:
        session: that it drives.
        stepper: makes the steps.
        metrics: gets their durations.
        timer: of the session's deadlines.
        is_driving: whether the connection is the controller still, and has settled what comes
            before the first step.
        write, send: to the client, the second where the first cannot.
    """

    def __init__(
        self,
        session: Session,
        stepper: Stepper,
        metrics: Metrics,
        *,
        timer: DeadlineTimer,
        is_driving: Callable[[], bool],
        write: Write,
        send: Send,
    ) -> None:
        self._session = session
        self._stepper = stepper
        self._metrics = metrics
        self._timer = timer
        self._is_driving = is_driving
        self._write = write
        self._send = send
        self._context = copy_context()
        self._waits = self._busy = False
        self._settled: asyncio.Future[None] | None = None
        self._ending: asyncio.Task[None] | None = None

    async def between(self, receive: Callable[[], Awaitable[T]]) -> T:
        """The next message that is not taken here; steps begin only while one is awaited, and have
        been answered when this returns: messages are answered in order."""
        self._waits = True
        try:
            return await receive()
        finally:
            self._waits = False
            while self._busy:
                self._settled = asyncio.get_running_loop().create_future()
                await self._settled

    def take(self, data: bytes) -> bool:
        """Begin the step that a message asks for; False where it has to go the ordinary way, and
        nothing has happened."""
        session, world = self._session, self._session.world
        if not self._waits or self._busy or len(data) > SMALL_BYTES:
            return False
        if world is None or session.cameras or world.ranging:
            return False
        if not session.hold.free:
            return False
        if session.closed is not None or session.lock.locked() or not self._is_driving():
            return False
        action = action_in(data)
        # Without sensors nothing is written to a slot.
        if action is None or (action.message.slot or 0) >= SLOTS:
            return False
        return self._context.run(self._begin, action.message, action.content)

    def _begin(self, action: Action, content: bytes) -> bool:
        session, timer = self._session, self._timer
        if not session.lockstep.is_due(action.step) or not _acquired_at_once(session.lock):
            return False
        account = ACCOUNT.get()
        if account is None or account.revoked or account.limits.requests_per_second is not None:
            session.lock.release()
            return False
        account.requests += 1
        session.touch()
        due = DueAction(session, action.plan, content, timer.waited_us)
        timer.cancel()
        self._busy = True
        self._stepper.begin_step(
            due,
            write=partial(self._write, action.id),
            done=partial(self._ended, action.id, time.perf_counter()),
        )
        return True

    def _ended(
        self, message_id: int, began: float, outcome: tuple[EncodedObservation, bool] | BrokenStep
    ) -> None:
        if isinstance(outcome, BrokenStep):
            self._end_later(self._refused(message_id, outcome))
            return
        observation, is_written = outcome
        self._metrics.steps.observe(time.perf_counter() - began)
        if is_written:
            self._end()
        else:
            self._end_later(self._send(observation.answer, message_id))

    def _end_later(self, ending: Awaitable[None]) -> None:
        async def awaited() -> None:
            try:
                # A client that has left gets no answer.
                with contextlib.suppress(WebSocketDisconnect):
                    await ending
            finally:
                self._end()

        loop = asyncio.get_running_loop()
        self._ending = loop.create_task(awaited(), context=self._context)

    async def _refused(self, message_id: int, broken: BrokenStep) -> None:
        try:
            await self._stepper.withdraw(broken)
            refusal = service_error(broken.error, log_unexpected=True)
        except Exception as error:
            refusal = service_error(error, log_unexpected=True)
        answer = error_message(refusal, step=self._session.lockstep.step)
        await self._send(answer, message_id)

    def _end(self) -> None:
        self._busy = False
        self._session.lock.release()
        if self._is_driving() and not self._timer.waiting:
            self._timer.start()
        if self._settled is not None and not self._settled.done():
            self._settled.set_result(None)


def _acquired_at_once(lock: asyncio.Lock) -> bool:
    """Take a lock that nobody holds or waits for; whether it is taken."""
    acquiring = lock.acquire()
    try:
        acquiring.send(None)
    except StopIteration:
        return True
    # Somebody is about to wake up with it.
    acquiring.close()
    return False
