"""A drive socket after its hello: messages in lockstep, or as an observer.

It contains the first two phases of a step, ``_receive`` and ``_check``; see `pipeline` for the
others.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import assert_never

import structlog
from prometheus_client import Counter
from starlette.websockets import WebSocket, WebSocketDisconnect

from real2sim_proto import ErrorCode
from real2sim_proto.drive import (
    Action,
    Agent,
    Attach,
    Bye,
    ClientMessage,
    Edit,
    Fork,
    Hello,
    Render,
    Reset,
    Restore,
    Snapshot,
)

from .. import clock
from ..accounts import admit_message
from ..http.requests import IdempotentRequest
from ..http.responses import ServiceError, service_error
from .messages import (
    PROGRESS_S,
    BadMessageError,
    FatalError,
    ReceivedMessage,
    bad_message,
    close_with_error,
    error_message,
    is_resuming,
    receive,
    send,
    with_progress,
)
from .registry import Sessions
from .sensors import ranging_for_render
from .session import ObserverQueue, Session, controller_taken, result_fields, welcome_fields
from .shared_memory import FrameSlot, Segment
from .step import Stepper
from .wire import EncodedMessage, pack_message

log = structlog.get_logger(__name__)

Send = Callable[[EncodedMessage], Awaitable[None]]


class DeadlineTimer:
    """Waits for the due action of one connected controller.

    The deadline counts from sending the observation to receiving the action. It excludes
    computation and lost connections. A fallback step waits in the same queue as any other step and
    does not delay other sessions.

    Args:
        session: session of the controller.
        stepper: computes the fallback step.
        send: sends the observation of a fallback step.
        missed: counts missed deadlines.
    """

    def __init__(self, session: Session, stepper: Stepper, send: Send, *, missed: Counter) -> None:
        self._session = session
        self._stepper = stepper
        self._send = send
        self._missed = missed
        self._waiting: asyncio.Task[None] | None = None
        self._sent_at = clock.monotonic()

    def start(self) -> None:
        """Start waiting: an observation has been sent."""
        self._sent_at = clock.monotonic()
        self.cancel()
        session = self._session
        if session.world is None or session.world.over:
            return
        deadline, cap = session.spec.deadline_ms, session.expires_at
        if (deadline is not None and not session.late) or cap is not None:
            self._waiting = asyncio.create_task(self._wait(session.world.steps))

    def cancel(self) -> None:
        """Stop waiting: the action has arrived, or the controller has left."""
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    @property
    def waiting(self) -> bool:
        """Whether an action is due."""
        return self._waiting is not None and not self._waiting.done()

    @property
    def waited_us(self) -> int:
        """Time since the newest observation was sent [us]."""
        return int((clock.monotonic() - self._sent_at) * 1e6)

    async def _wait(self, step: int) -> None:
        try:
            while (until := self._next(step)) is not None:
                await clock.sleep_until(until)
                # An arriving action must not cancel a fallback step in progress.
                await asyncio.shield(asyncio.ensure_future(self._expire(step)))
                step = self._session.lockstep.step or 0
        except Exception:
            log.exception("fallback failed", session_id=self._session.session_id)

    def _next(self, step: int) -> float | None:
        """Monotonic time of the next deadline, or None."""
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


CLOSE_TIMEOUT_S = 2.0

ALLOWED_MESSAGES: dict[str, tuple[type, ...]] = {
    "controller": (Hello, Attach, Reset, Action, Edit, Render, Agent, Snapshot, Restore, Fork, Bye),
    "observer": (Hello, Render, Bye),
    "agent": (Hello, Agent, Render, Bye),
}

NORMAL_CLOSURE = 1000


class Connection:
    """An accepted drive socket of a session.

    Args:
        socket: socket with a valid hello.
        session: its session.
        sessions: the session's registry.
        ws_base: address of this worker for clients, for example ``ws://127.0.0.1:8600``.
    """

    def __init__(
        self, socket: WebSocket, session: Session, sessions: Sessions, *, ws_base: str
    ) -> None:
        self._socket = socket
        self._session = session
        self._sessions = sessions
        self._ws_base = ws_base
        self._sending = asyncio.Lock()
        self._segment: Segment | None = None
        self._deadline_timer = DeadlineTimer(
            session, sessions.stepper, self._send, missed=sessions.metrics.missed_deadlines
        )

    async def serve(self, hello: Hello) -> None:
        """Serve until either side disconnects. A lost client is not an error."""
        session = self._session
        try:
            session.check_open()
            session.close_callbacks.add(self._close_with_error)
            if hello.role == "controller":
                async with self._as_controller(hello):
                    await self._welcome(hello)
                    await self._resend_missed_observation(hello)
                    await self._serve_messages(hello.role)
            else:
                await self._welcome(hello)
                async with self._as_observer():
                    await self._serve_messages(hello.role)
        except WebSocketDisconnect:
            pass
        except FatalError as error:
            await self._close_with_error(error.error, message_id=error.message_id)
        except ServiceError as error:
            await self._close_with_error(error)
        finally:
            session.close_callbacks.discard(self._close_with_error)
            self._release_segment()
            session.touch()

    # --- welcome ----------------------------------------------------------------------------

    async def _welcome(self, hello: Hello) -> None:
        """Warm up, with progress messages, and send the current state."""
        warming = self._sessions.warm_up(self._session)
        try:
            await with_progress(
                self._socket, warming, hello, phase="warming up: kernels and first render"
            )
        except WebSocketDisconnect:
            raise
        except Exception as error:
            failure = service_error(error, log_unexpected=True)
            raise FatalError(failure, message_id=hello.id) from error
        fields = await asyncio.to_thread(welcome_fields, self._session, hello.role)
        if hello.role == "controller":
            self._segment = self._sessions.segments.create()
            fields["shared_memory"] = None if self._segment is None else self._segment.offer
        await self._send(pack_message("welcome", fields), hello.id)

    @contextlib.asynccontextmanager
    async def _as_controller(self, hello: Hello) -> AsyncIterator[None]:
        session = self._session
        old = session.controller
        if old is not None and not is_resuming(hello, session.resume_token):
            raise FatalError(controller_taken(session.session_id), message_id=hello.id)
        session.controller, session.tell_controller = self, self._send
        if isinstance(old, Connection):
            # Its client has reconnected; the old connection may never notice.
            await old.yield_control()
        try:
            yield
        finally:
            self._deadline_timer.cancel()
            if session.controller is self:
                session.controller = session.tell_controller = None

    async def end(self, error: ServiceError) -> None:
        """Send the reason to the client and disconnect."""
        await self._close_with_error(error)

    async def yield_control(self) -> None:
        """Leave the session to the connection that resumed it."""
        self._session.close_callbacks.discard(self._close_with_error)
        self._deadline_timer.cancel()
        await self._close_with_error(controller_taken(self._session.session_id))

    async def _resend_missed_observation(self, hello: Hello) -> None:
        """Send a reconnected controller the current observation, unless it has it."""
        session = self._session
        async with session.lock:
            newest, step = session.newest, session.lockstep.step
            missing = hello.resume is not None and hello.resume.last_step != step
            if missing and newest is not None:
                await self._send(newest)
        self._deadline_timer.start()

    @contextlib.asynccontextmanager
    async def _as_observer(self) -> AsyncIterator[None]:
        queue = ObserverQueue()
        self._session.observers.add(queue)
        forwarding = asyncio.create_task(self._forward(queue))
        try:
            yield
        finally:
            self._session.observers.discard(queue)
            forwarding.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await forwarding

    async def _forward(self, queue: ObserverQueue) -> None:
        # The receiver notices when the client leaves.
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await self._send(await queue.take())

    # --- messages ---------------------------------------------------------------------------

    async def _serve_messages(self, role: str) -> None:
        """Answer every message with one message, in order, until bye."""
        while True:
            try:
                received = await self._receive()
                await self._send(await self._answer(received, role), received.message.id)
                if role == "controller" and not self._deadline_timer.waiting:
                    self._deadline_timer.start()
            except BadMessageError as error:
                if error.fatal:
                    raise FatalError(error.error, message_id=error.message_id) from error
                await self._send(self._error_message(error.error), error.message_id)
            else:
                if isinstance(received.message, Bye):
                    await self._socket.close(NORMAL_CLOSURE)
                    return

    async def _answer(self, received: ReceivedMessage, role: str) -> EncodedMessage:
        try:
            _check_role(received.message, role)
            admit_message()
            return await self._dispatch(received, role)
        except Exception as error:
            return self._error_message(service_error(error, log_unexpected=True))

    async def _dispatch(self, received: ReceivedMessage, role: str) -> EncodedMessage:
        message, session = received.message, self._session
        if self._segment is not None and not self._segment.attached:
            self._settle_offer(message)
        match message:
            case Action():
                return await self._act(message, received.content)
            case Reset():
                slot = self._slot(message.slot)
                self._deadline_timer.cancel()
                async with session.lock:
                    session.check_open()
                    return await self._sessions.stepper.reset(session, message.spec, slot=slot)
            case Edit():
                return await self._edit(message)
            case Render():
                session.check_open()
                world, slot = session.running_world(), self._slot(message.slot)
                view = await self._sessions.pipeline.view(
                    world,
                    message.sensors,
                    ranging=await ranging_for_render(world, message),
                    slot=slot,
                )
                return view.answer
            case Attach() | Agent() | Snapshot() | Restore() | Fork():
                async with session.lock:
                    session.check_open()
                    return await self._change(message)
            case Bye():
                return await self._finish(role)
            case Hello():
                raise bad_message("hello was already received")
            case _:
                assert_never(message)

    async def _act(self, action: Action, content: bytes) -> EncodedMessage:
        """Check an action, and run it through the rest of the step pipeline."""
        session, waited_us = self._session, self._deadline_timer.waited_us
        arrived, slot = time.perf_counter(), self._slot(action.slot)
        if action.step == session.lockstep.step:
            self._deadline_timer.cancel()
        await self._wait_for_clock(action)
        async with session.lock:
            given_before = self._check(action, content)
            if given_before is not None:
                return given_before
            session.hold.take_step(session.spec.dt_us)
            answer = await self._sessions.stepper.act(
                session,
                action.plan,
                content,
                waited_us=waited_us,
                slot=slot,
            )
            self._sessions.metrics.steps.observe(time.perf_counter() - arrived)
            return answer

    async def _wait_for_clock(self, action: Action) -> None:
        """Wait until the clock lets the action pass.

        Sends progress messages while the clock is held, so that clients do not time out.
        """
        session = self._session
        while (wait_s := session.hold.wait_s) > 0 and session.lockstep.is_due(action.step):
            session.check_open()
            session.touch()
            if session.hold.held:
                fields = {"phase": "the clock is held", "eta_s": None}
                await self._send(pack_message("progress", fields), action.id)
            await session.hold.wait(min(wait_s, PROGRESS_S))

    def _check(self, action: Action, content: bytes) -> EncodedMessage | None:
        """The stored answer to a repeated action; None if the action is due.

        Raises:
            ServiceError: the session has ended, or the action is for another step.
        """
        self._session.check_open()
        return self._session.lockstep.cached_answer(action.step, content)

    async def _change(self, message: Attach | Agent | Snapshot | Restore | Fork) -> EncodedMessage:
        """Apply a message other than a step or an edit. The caller holds the session's lock."""
        session, stepper = self._session, self._sessions.stepper
        match message:
            case Attach():
                return self._attached()
            case Agent():
                await stepper.set_agent_plan(session, message)
                fields = {"object_id": message.object_id, "step": session.running_world().steps}
                return pack_message("driven", fields)
            case Snapshot():
                world = await stepper.snapshot(session, message.name)
                fields = {"name": message.name, "step": world.steps, "t_us": world.t_us}
                return pack_message("kept", fields)
            case Restore():
                self._deadline_timer.cancel()
                return await stepper.restore(session, message.name)
            case Fork():
                info = await self._sessions.fork(
                    session, ws_base=self._ws_base, idempotent=IdempotentRequest()
                )
                fields = info.model_dump(include={"session_id", "token", "ws_url"})
                fields["step"] = session.running_world().steps
                return pack_message("forked", fields)
            case _:
                assert_never(message)

    async def _edit(self, edit: Edit) -> EncodedMessage:
        session = self._session
        async with session.lock:
            session.check_open()
            outcome = await self._sessions.stepper.edit(
                session, edit.operations, base_rev=edit.base_rev
            )
            revision = session.running_world().revision
        warnings = [w.model_dump(mode="json", exclude_none=True) for w in outcome.warnings]
        fields = {"revision": revision, "created": list(outcome.created), "warnings": warnings}
        return pack_message("edited", fields)

    async def _finish(self, role: str) -> EncodedMessage:
        """The result; a bye of the controller ends the session."""
        session = self._session
        scores = await self._sessions.scores(session)
        if role == "controller":
            self._deadline_timer.cancel()
            session.close_callbacks.discard(self._close_with_error)
            await self._sessions.close(session, reason="its controller ended it")
        return pack_message("result", result_fields(session.world, scores))

    # --- shared memory ------------------------------------------------------------------------

    def _settle_offer(self, message: ClientMessage) -> None:
        """Read from the first message after the welcome whether the client has opened the memory.

        Raises:
            ServiceError: INVALID_REQUEST if the client confirms it with a wrong secret.
        """
        assert self._segment is not None
        try:
            if isinstance(message, Attach):
                self._segment.attach(message.secret)
        finally:
            if not self._segment.attached:
                self._release_segment()

    def _attached(self) -> EncodedMessage:
        if self._segment is None:
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                "no shared memory is offered on this connection, or no longer",
                hint="attach is the first message after a welcome with `shared_memory`",
            )
        return pack_message("attached", {})

    def _slot(self, number: int | None) -> FrameSlot | None:
        return None if self._segment is None else self._segment.slot(number)

    def _release_segment(self) -> None:
        if self._segment is not None:
            self._segment.close()
            self._segment = None

    # --- bytes ------------------------------------------------------------------------------

    async def _receive(self) -> ReceivedMessage:
        received = await receive(self._socket)
        self._session.touch()
        return received

    async def _send(self, message: EncodedMessage, message_id: int = 0) -> None:
        # Another task sends the end of the session.
        async with self._sending:
            await send(self._socket, message, message_id)

    async def _close_with_error(self, error: ServiceError, *, message_id: int = 0) -> None:
        """Send the error and close, without waiting for a client that does not read."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT_S), self._sending:
                step = self._session.lockstep.step
                await close_with_error(self._socket, error, message_id=message_id, step=step)

    def _error_message(self, error: ServiceError) -> EncodedMessage:
        return error_message(error, step=self._session.lockstep.step)


def _check_role(message: ClientMessage, role: str) -> None:
    """Raises ServiceError: NOT_CONTROLLER for a message that observers may not send."""
    allowed = ALLOWED_MESSAGES[role]
    if isinstance(message, allowed):
        return
    raise ServiceError(
        ErrorCode.NOT_CONTROLLER,
        f"{'an' if role[0] in 'ao' else 'a'} {role} sent {message.type}; such clients may "
        f"send {', '.join(kind.__name__.lower() for kind in allowed)}",
        hint="connect with role 'controller' to drive",
    )
