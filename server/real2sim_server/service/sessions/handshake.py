"""What comes before a connection belongs to a session: its hello, and who says it.

The session's row is enough to tell: a session that has left the memory is rebuilt for those alone
who have its token or the worker's.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from real2sim_proto import RETRYABLE, SUPPORTED_SUBPROTOCOLS, ErrorCode
from real2sim_proto.drive import Envelope, Hello

from ..http.auth import secrets_equal, unauthorized
from ..http.problems import ServiceError
from ..storage.store import SessionRow
from .messages import (
    BadMessageError,
    ReceivedMessage,
    bad_message,
    read_message,
    unsupported_protocol,
)
from .session import opens_session
from .wire import EncodedMessage, pack_message

T = TypeVar("T")

HANDSHAKE_TIMEOUT_S = 10.0
PROGRESS_S = 1.0
CLOSE_TIMEOUT_S = 2.0
SMALL_BYTES = 16_384
"""Messages up to this size are read on the event loop: that takes less than handing them over."""
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
    """The hello of a client that may use the session of a row.

    Args:
        socket: accepted with our subprotocol.
        row: of the session.
        authorised: whether the handshake carried the worker's token.
        opens_worker: whether a token is one of the worker's, which open every session.
        resume_token: of the session's controller.

    Raises:
        FatalError: anything else came, or nothing in time, or without a token.
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
    """Whether this is the session's controller who comes back."""
    resume = hello.resume
    return resume is not None and secrets_equal(resume.token, resume_token)


async def receive(socket: WebSocket) -> ReceivedMessage:
    """The next message.

    Raises:
        WebSocketDisconnect: the client has left.
        BadMessageError: what came is no message.
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
    """The result of ``work``; the client is told of a ``phase`` meanwhile."""
    task = asyncio.create_task(work)
    # Read the outcome even when the client has left meanwhile.
    task.add_done_callback(lambda done: done.cancelled() or done.exception())
    while not (await asyncio.wait({task}, timeout=PROGRESS_S))[0]:
        fields = {"phase": phase, "eta_s": None}
        await send(socket, pack_message("progress", fields), hello.id)
    return task.result()


async def close_with_error(
    socket: WebSocket, error: ServiceError, *, message_id: int = 0, step: int | None = None
) -> None:
    """Send the error and close; a client that does not read is left alone."""
    with contextlib.suppress(TimeoutError, WebSocketDisconnect, RuntimeError):
        async with asyncio.timeout(CLOSE_TIMEOUT_S):
            message = error_message(error, fatal=True, step=step)
            await send(socket, message, message_id)
            await socket.close(POLICY_VIOLATION, error.code.value)


def error_message(
    error: ServiceError, *, fatal: bool = False, step: int | None = None
) -> EncodedMessage:
    """An error as a message; ``step``: the one that is due."""
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
