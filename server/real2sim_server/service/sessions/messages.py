"""Strict parsing of clients' messages: hello, which opens a connection, and all later ones."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import ValidationError
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from real2sim_proto import (
    PROTOCOL_VERSION,
    RETRYABLE,
    SUPPORTED_SUBPROTOCOLS,
    CodecError,
    ErrorCode,
    decode,
    protocol_mismatch,
)
from real2sim_proto.base import invalid_reason
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES, unpack
from real2sim_proto.drive import CLIENT_MESSAGE, Action, ClientMessage, Envelope, Hello

from ..._records import made_quickly
from ...world.replay import plan_payload
from ..http.auth import secrets_equal, unauthorized
from ..http.responses import ServiceError
from ..storage.store import SessionRow
from .session import opens_session
from .wire import EncodedMessage, pack_message

MAX_PROBLEMS = 4
TYPES = "hello, attach, reset, action, edit, render, agent, snapshot, restore, fork, bye"


@made_quickly
@dataclass(frozen=True)
class ReceivedMessage:
    """One message of a client.

    Attributes:
        message: the parsed message.
        content: canonical bytes of an action's plan; empty for other messages.
    """

    message: ClientMessage
    content: bytes = b""


@made_quickly
@dataclass(frozen=True)
class ReceivedAction(ReceivedMessage):
    """An action of a client."""

    message: Action


class BadMessageError(Exception):
    """An invalid message.

    Attributes:
        error: sent to the client.
        message_id: id of the message, if readable.
        fatal: whether the connection must end.
    """

    def __init__(self, error: ServiceError, *, message_id: int = 0, fatal: bool = False) -> None:
        super().__init__(error.detail)
        self.error = error
        self.message_id = message_id
        self.fatal = fatal


def read_message(data: bytes) -> ReceivedMessage:
    """Parse the message in ``data``.

    Raises:
        BadMessageError: invalid; fatal if it has another protocol version.
    """
    if (action := action_in(data)) is not None:
        return action
    message = _read(data)
    content = plan_payload(message.plan) if isinstance(message, Action) else b""
    return ReceivedMessage(message, content)


def action_in(data: bytes) -> ReceivedAction | None:
    """Parse an action, the most frequent message; None for other or invalid messages.

    Values are validated once, because the model contains only types that the protocol carries.
    """
    try:
        fields = unpack(data)
        if fields["type"] == "action" and type(fields["v"]) is int:
            message = CLIENT_MESSAGE.validator.validate_python(fields)
            if isinstance(message, Action):
                return ReceivedAction(message, plan_payload(message.plan))
    except Exception:
        # The general parser raises the same error with an explanation.
        return None
    return None


def _read(data: bytes) -> ClientMessage:
    """Parse the message in ``data``. Raises as :func:`read_message` does."""
    try:
        fields = decode(data, max_bytes=MAX_CLIENT_MESSAGE_BYTES)
    except CodecError as error:
        raise BadMessageError(bad_message(str(error))) from error
    message_id = _id_of(fields)
    version = fields.get("v", PROTOCOL_VERSION)
    # An array would be compared element by element.
    if type(version) is not int or version != PROTOCOL_VERSION:
        detail = (
            f"the message has protocol version {version!r}; this worker speaks {PROTOCOL_VERSION}. "
            "Install a client and a worker of the same major version."
        )
        mismatch = ServiceError(ErrorCode.UNSUPPORTED_PROTOCOL, detail)
        raise BadMessageError(mismatch, message_id=message_id, fatal=True)
    try:
        return CLIENT_MESSAGE.validate_python(fields)
    except ValidationError as error:
        raise BadMessageError(
            bad_message(validation_summary(error)), message_id=message_id
        ) from error


def bad_message(detail: str) -> ServiceError:
    """A BAD_MESSAGE error."""
    return ServiceError(
        ErrorCode.BAD_MESSAGE, detail, hint=f"messages are msgpack maps with a type: {TYPES}"
    )


def unsupported_protocol(offered: list[str]) -> ServiceError:
    """An UNSUPPORTED_PROTOCOL error with the versions of both sides."""
    return ServiceError(ErrorCode.UNSUPPORTED_PROTOCOL, protocol_mismatch(offered))


def _id_of(fields: dict[str, Any]) -> int:
    given = fields.get("id", 0)
    return given if type(given) is int and 0 <= given <= 2**53 else 0


def validation_summary(error: ValidationError) -> str:
    """The error and its location: ``action/plan/poses/0/1: must be a finite number, got NaN``."""
    found = error.errors(include_url=False, include_context=False)
    texts = []
    for problem in found[:MAX_PROBLEMS]:
        place = "/".join(str(part) for part in problem["loc"]) or "message"
        texts.append(f"{place}: {invalid_reason(problem)}")
    more = f"; and {len(found) - MAX_PROBLEMS} more" if len(found) > MAX_PROBLEMS else ""
    return "; ".join(texts) + more


T = TypeVar("T")

HANDSHAKE_TIMEOUT_S = 10.0
PROGRESS_S = 1.0
CLOSE_TIMEOUT_S = 2.0
SMALL_BYTES = 16_384
"""Messages up to this size are parsed on the event loop, which is faster than another thread."""
POLICY_VIOLATION = 1008


class FatalError(Exception):
    """Ends the connection with an error message."""

    def __init__(self, error: ServiceError, *, message_id: int = 0) -> None:
        super().__init__(error.detail)
        self.error = error
        self.message_id = message_id


async def receive_hello(
    socket: WebSocket,
    row: SessionRow,
    *,
    authorised: bool,
    opens_worker: Callable[[str | None], bool],
    resume_token: str,
) -> Hello:
    """Receive the hello of a client that may use a session.

    Args:
        socket: accepted with the drive subprotocol.
        row: the session's row in the store.
        authorised: whether the handshake carried the worker token.
        opens_worker: returns whether a token is a worker token, which opens every session.
        resume_token: token of the session's controller.

    Raises:
        FatalError: another message, a timeout, or a missing token.
        WebSocketDisconnect: the client has left.
    """
    try:
        async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
            message = (await receive(socket)).message
    except TimeoutError as error:
        detail = f"no hello within {HANDSHAKE_TIMEOUT_S:g} s"
        raise FatalError(ServiceError(ErrorCode.TIMEOUT, detail)) from error
    except BadMessageError as error:
        raise FatalError(error.error, message_id=error.message_id) from error
    if not isinstance(message, Hello):
        wrong_type = bad_message(f"the first message must be hello, not {message.type}")
        raise FatalError(wrong_type, message_id=message.id)
    if not set(message.protocols) & set(SUPPORTED_SUBPROTOCOLS):
        raise FatalError(unsupported_protocol(message.protocols), message_id=message.id)
    has_token = opens_session(message.token, row) or opens_worker(message.token)
    if not (authorised or has_token or is_resuming(message, resume_token)):
        no_token = unauthorized("hello carries neither the session's token nor the worker's")
        no_token.hint = "the answer to POST /v1/sessions has the session's token"
        raise FatalError(no_token, message_id=message.id)
    return message


def is_resuming(hello: Hello, resume_token: str) -> bool:
    """Whether this is the session's controller, reconnecting."""
    resume = hello.resume
    return resume is not None and secrets_equal(resume.token, resume_token)


async def receive(socket: WebSocket) -> ReceivedMessage:
    """The next message.

    Raises:
        WebSocketDisconnect: the client has left.
        BadMessageError: an invalid message.
    """
    event = await socket.receive()
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event.get("code", 1005))
    data = event.get("bytes")
    if data is None:
        raise BadMessageError(bad_message("text was sent where messages are binary"))
    if len(data) <= SMALL_BYTES:
        return read_message(data)
    return await asyncio.to_thread(read_message, data)


async def send(socket: WebSocket, message: EncodedMessage, message_id: int = 0) -> None:
    """Send a message. Raises WebSocketDisconnect: the client has left."""
    if socket.application_state is WebSocketState.DISCONNECTED:
        raise WebSocketDisconnect
    await socket.send_bytes(message.joined(message_id))


async def with_progress(
    socket: WebSocket, work: Coroutine[Any, Any, T], hello: Envelope, *, phase: str
) -> T:
    """The result of ``work``; meanwhile, the client receives progress messages for ``phase``."""
    task = asyncio.create_task(work)
    # Retrieve the outcome even if the client has left.
    task.add_done_callback(lambda done: done.cancelled() or done.exception())
    while not (await asyncio.wait({task}, timeout=PROGRESS_S))[0]:
        fields = {"phase": phase, "eta_s": None}
        await send(socket, pack_message("progress", fields), hello.id)
    return task.result()


async def close_with_error(
    socket: WebSocket, error: ServiceError, *, message_id: int = 0, step: int | None = None
) -> None:
    """Send the error and close, without waiting for a client that does not read."""
    with contextlib.suppress(TimeoutError, WebSocketDisconnect, RuntimeError):
        async with asyncio.timeout(CLOSE_TIMEOUT_S):
            message = error_message(error, fatal=True, step=step)
            await send(socket, message, message_id)
            await socket.close(POLICY_VIOLATION, error.code.value)


def error_message(
    error: ServiceError, *, fatal: bool = False, step: int | None = None
) -> EncodedMessage:
    """An error as a message; ``step`` is the step that is due."""
    fields = {
        "code": error.code.value,
        "detail": error.detail,
        "hint": error.hint,
        "retryable": error.code in RETRYABLE,
        "step": step,
        "retry_after_s": int(error.headers.get("Retry-After", 0)) or None,
        "fatal": fatal,
    }
    return pack_message("error", fields)
