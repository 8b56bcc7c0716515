"""One drive socket: greeted, then served in lock step or as an observer."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any, assert_never

import structlog
from starlette.websockets import WebSocket, WebSocketDisconnect

from real2sim_proto import RETRYABLE, SUPPORTED_SUBPROTOCOLS, ErrorCode
from real2sim_proto.drive import (
    Action,
    Agent,
    Bye,
    Edit,
    Fork,
    Hello,
    Render,
    Reset,
    Restore,
    Snapshot,
)

from ..http.auth import opens, same_secret, unauthorized
from ..http.problems import ServiceError, service_error
from ..http.websocket import send, written
from .deadline_timer import DeadlineTimer
from .describe import welcome_fields
from .messages import BadMessageError, Incoming, bad_message, read_message, unsupported_protocol
from .observers import Mailbox
from .registry import Sessions
from .session import Session, controller_taken
from .wire import Message, pack_message

HANDSHAKE_TIMEOUT_S = 10.0
PROGRESS_S = 1.0
CLOSE_TIMEOUT_S = 2.0
SMALL_BYTES = 16_384
"""Messages up to this size are read on the event loop: that takes less than handing them over."""

MAY_SEND: dict[str, tuple[type, ...]] = {
    "controller": (Hello, Reset, Action, Edit, Render, Agent, Snapshot, Restore, Fork, Bye),
    "observer": (Hello, Render, Bye),
    "agent": (Hello, Agent, Render, Bye),
}

POLICY_VIOLATION = 1008
NORMAL_CLOSURE = 1000

log = structlog.get_logger(__name__)


class FatalError(Exception):
    """Ends the connection after telling the client why."""

    def __init__(self, refusal: ServiceError, *, message_id: int = 0) -> None:
        super().__init__(refusal.detail)
        self.refusal = refusal
        self.message_id = message_id


class Connection:
    """An accepted drive socket of a session.

    Args:
        socket: accepted with our subprotocol.
        session: that it belongs to.
        sessions: the session's registry.
        authorised: whether the handshake carried the worker's token.
        worker_token: opens every session; None where the worker has none.
        ws_base: how clients reach this worker, for example ``ws://127.0.0.1:8600``.
    """

    def __init__(
        self,
        socket: WebSocket,
        session: Session,
        sessions: Sessions,
        *,
        authorised: bool,
        worker_token: str | None,
        ws_base: str,
    ) -> None:
        self._socket = socket
        self._session = session
        self._sessions = sessions
        self._authorised = authorised
        self._worker_token = worker_token
        self._ws_base = ws_base
        self._sending = asyncio.Lock()
        self._patience = DeadlineTimer(session, sessions.stepper, self._send)

    async def serve(self) -> None:
        """Talk until one of both leaves. A client that vanishes disturbs nobody."""
        session = self._session
        try:
            hello = await self._greeting()
            session.check_open()
            session.hangups.add(self._hang_up)
            if hello.role == "controller":
                async with self._as_controller(hello):
                    await self._welcome(hello)
                    await self._catch_up(hello)
                    await self._converse(hello.role)
            else:
                await self._welcome(hello)
                async with self._as_observer():
                    await self._converse(hello.role)
        except WebSocketDisconnect:
            pass
        except (FatalError, ServiceError) as error:
            refusal = error.refusal if isinstance(error, FatalError) else error
            message_id = error.message_id if isinstance(error, FatalError) else 0
            await self._hang_up(refusal, message_id=message_id)
        finally:
            session.hangups.discard(self._hang_up)
            session.touch()

    # --- greeting ---------------------------------------------------------------------------

    async def _greeting(self) -> Hello:
        """The client's hello. Raises FatalError when there is no talking to it."""
        try:
            async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
                message = (await self._receive()).message
        except TimeoutError as error:
            refusal = ServiceError(ErrorCode.TIMEOUT, f"no hello within {HANDSHAKE_TIMEOUT_S:g} s")
            raise FatalError(refusal) from error
        except BadMessageError as error:
            raise FatalError(error.refusal, message_id=error.message_id) from error
        if not isinstance(message, Hello):
            refusal = bad_message(f"the first message must be hello, not {message.type}")
            raise FatalError(refusal, message_id=message.id)
        if not set(message.protocols) & set(SUPPORTED_SUBPROTOCOLS):
            raise FatalError(unsupported_protocol(message.protocols), message_id=message.id)
        if not (self._authorised or self._resumes(message) or self._opens(message)):
            refusal = unauthorized("hello carries neither the session's token nor the worker's")
            refusal.hint = "the answer to POST /v1/sessions has the session's token"
            raise FatalError(refusal, message_id=message.id)
        return message

    def _opens(self, hello: Hello) -> bool:
        return opens(hello.token, self._session.row.token, self._worker_token)

    def _resumes(self, hello: Hello) -> bool:
        """Whether this is the session's controller who comes back."""
        resume = hello.resume
        return resume is not None and same_secret(resume.token, self._session.resume_token)

    async def _welcome(self, hello: Hello) -> None:
        """Have everything warm, saying so meanwhile, and tell the client what there is."""
        warming = asyncio.create_task(self._sessions.warm_up(self._session))
        # Read the outcome even when the client has left meanwhile.
        warming.add_done_callback(lambda task: task.cancelled() or task.exception())
        while not (await asyncio.wait({warming}, timeout=PROGRESS_S))[0]:
            fields = {"phase": "warming up: kernels and first render", "eta_s": None}
            await self._send(pack_message("progress", fields), hello.id)
        try:
            await warming
        except Exception as error:
            raise FatalError(_told(error), message_id=hello.id) from error
        fields = await asyncio.to_thread(welcome_fields, self._session, hello.role)
        await self._send(pack_message("welcome", fields), hello.id)

    @contextlib.asynccontextmanager
    async def _as_controller(self, hello: Hello) -> AsyncIterator[None]:
        session = self._session
        old = session.controller
        if old is not None and not self._resumes(hello):
            raise FatalError(controller_taken(session.session_id), message_id=hello.id)
        session.controller = self
        if isinstance(old, Connection):
            # Its client has come back by another way; the old one may never notice.
            await old.give_way()
        try:
            yield
        finally:
            self._patience.end()
            if session.controller is self:
                session.controller = None

    async def give_way(self) -> None:
        """Leave the session to the connection that has resumed it."""
        self._session.hangups.discard(self._hang_up)
        self._patience.end()
        await self._hang_up(controller_taken(self._session.session_id))

    async def _catch_up(self, hello: Hello) -> None:
        """Send a controller that comes back the present observation, unless it has it."""
        session = self._session
        async with session.lock:
            newest, step = session.newest, session.lockstep.step
            missing = hello.resume is not None and hello.resume.last_step != step
            if missing and newest is not None:
                await self._send(newest)
        self._patience.begin()

    @contextlib.asynccontextmanager
    async def _as_observer(self) -> AsyncIterator[None]:
        mailbox = Mailbox()
        self._session.observers.add(mailbox)
        forwarding = asyncio.create_task(self._forward(mailbox))
        try:
            yield
        finally:
            self._session.observers.discard(mailbox)
            forwarding.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await forwarding

    async def _forward(self, mailbox: Mailbox) -> None:
        # A client that left is noticed by whoever receives from it.
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await self._send(await mailbox.take())

    # --- conversation -----------------------------------------------------------------------

    async def _converse(self, role: str) -> None:
        """Answer every message with one message, in order, until bye."""
        while True:
            try:
                incoming = await self._receive()
                if (answer := await self._answer(incoming, role)) is not None:
                    await self._send(answer, incoming.message.id)
                if role == "controller" and not self._patience.waiting:
                    self._patience.begin()
            except BadMessageError as error:
                if error.fatal:
                    raise FatalError(error.refusal, message_id=error.message_id) from error
                await self._send(self._error(error.refusal), error.message_id)
            else:
                if isinstance(incoming.message, Bye):
                    await self._socket.close(NORMAL_CLOSURE)
                    return

    async def _answer(self, incoming: Incoming, role: str) -> Message | None:
        """The answer; None where it has been sent already."""
        message, allowed = incoming.message, MAY_SEND[role]
        if not isinstance(message, allowed):
            refusal = ServiceError(
                ErrorCode.NOT_CONTROLLER,
                f"{'an' if role[0] in 'ao' else 'a'} {role} sent {message.type}; such clients may "
                f"send {', '.join(kind.__name__.lower() for kind in allowed)}",
                hint="connect with role 'controller' to drive",
            )
            return self._error(refusal)
        try:
            return await self._obey(incoming, role)
        except Exception as error:
            return self._error(_told(error))

    async def _obey(self, incoming: Incoming, role: str) -> Message | None:
        message, session, stepper = incoming.message, self._session, self._sessions.stepper
        match message:
            case Action():
                return await self._act(message, incoming.content)
            case Reset():
                self._patience.end()
                async with session.lock:
                    session.check_open()
                    return await stepper.reset(session, message.spec)
            case Edit():
                return await self._edit(message)
            case Render():
                session.check_open()
                shown = await self._sessions.show.view(session.running_world(), message.sensors)
                return shown.message
            case Agent() | Snapshot() | Restore() | Fork():
                async with session.lock:
                    session.check_open()
                    return await self._change(message)
            case Bye():
                return await self._leave(role)
            case Hello():
                raise bad_message("hello has been said already")
            case _:
                assert_never(message)

    async def _act(self, action: Action, content: bytes) -> Message | None:
        session, told = self._session, False

        def tell(message: Message) -> None:
            nonlocal told
            told = not self._sending.locked() and written(self._socket, message.parts(action.id))

        waited_us = self._patience.waited_us
        if action.step == session.lockstep.step:
            self._patience.end()
        async with session.lock:
            session.check_open()
            cached = session.lockstep.cached_answer(action.step, content)
            if cached is not None:
                return cached
            message = await self._sessions.stepper.act(
                session, action.plan, content, latency_us=waited_us, tell=tell
            )
            return None if told else message

    async def _change(self, asked: Agent | Snapshot | Restore | Fork) -> Message:
        """Everything that is rare, for whoever holds the session's lock."""
        session, stepper = self._session, self._sessions.stepper
        match asked:
            case Agent():
                await stepper.steer(session, asked)
                fields = {"object_id": asked.object_id, "step": session.running_world().steps}
                return pack_message("driven", fields)
            case Snapshot():
                kept = await stepper.snapshot(session, asked.name)
                fields = {"name": asked.name, "step": kept.steps, "t_us": kept.t_us}
                return pack_message("kept", fields)
            case Restore():
                self._patience.end()
                return await stepper.restore(session, asked.name)
            case Fork():
                info = await self._sessions.fork(session, ws_base=self._ws_base)
                fields = info.model_dump(include={"session_id", "token", "ws_url"})
                fields["step"] = session.running_world().steps
                return pack_message("forked", fields)
            case _:
                assert_never(asked)

    async def _edit(self, edit: Edit) -> Message:
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

    async def _leave(self, role: str) -> Message:
        """The result; a controller that says bye ends the session."""
        session = self._session
        scores = await self._sessions.scores(session)
        if role == "controller":
            self._patience.end()
            session.hangups.discard(self._hang_up)
            await self._sessions.close(session, reason="its controller said bye")
        world = session.world
        fields = {
            "steps": world.steps if world else 0,
            "t_us": world.t_us if world else None,
            "reason": world.reason if world else None,
            "metrics": world.metrics() if world else {},
            "scores": [score.fields() for score in scores],
        }
        return pack_message("result", fields)

    # --- bytes ------------------------------------------------------------------------------

    async def _receive(self) -> Incoming:
        event = await self._socket.receive()
        if event["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(event.get("code", 1005))
        self._session.touch()
        data = event.get("bytes")
        if data is None:
            raise BadMessageError(bad_message("text was sent where messages are binary"))
        if len(data) <= SMALL_BYTES:
            return read_message(data)
        return await asyncio.to_thread(read_message, data)

    async def _send(self, message: Message, message_id: int = 0) -> None:
        # Whoever ends the session may send too.
        async with self._sending:
            await send(self._socket, message.parts(message_id))

    async def _hang_up(self, refusal: ServiceError, *, message_id: int = 0) -> None:
        """Tell the client why this is over and close; one that does not listen is left alone."""
        with contextlib.suppress(TimeoutError, WebSocketDisconnect, RuntimeError):
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await self._send(self._error(refusal, fatal=True), message_id)
                await self._socket.close(POLICY_VIOLATION, refusal.code.value)

    def _error(self, refusal: ServiceError, *, fatal: bool = False) -> Message:
        fields: dict[str, Any] = {
            "code": refusal.code.value,
            "detail": refusal.detail,
            "hint": refusal.hint,
            "retryable": refusal.code in RETRYABLE,
            "fatal": fatal,
            "step": self._session.lockstep.step,
        }
        return pack_message("error", fields)


def _told(error: Exception) -> ServiceError:
    refusal = service_error(error)
    if refusal.code is ErrorCode.INTERNAL:
        log.error("unexpected error", exc_info=error)
    return refusal
