"""Connections of clients: their number, and timeouts for slow clients.

uvicorn's protocols serve every connection. :class:`Connection` wraps them and forwards the events
of asyncio. An ASGI wrapper around the application reports when a request begins, waits for its body
and ends. A sweep checks all connections once a second. If there are too many, it closes those that
have been silent for longest while it was their turn to send. WebSockets and requests in progress
are not closed.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import time
from collections import Counter
from contextvars import ContextVar
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, cast

import h11
import structlog
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.exceptions import InvalidState

from real2sim_proto import HTTP_STATUS, PROBLEM_MEDIA_TYPE, ErrorCode

from .auth import is_loopback
from .responses import SECURITY_HEADERS, ServiceError, problem_of

if TYPE_CHECKING:
    import uvicorn

    from .telemetry import Metrics

SWEEP_S = 1.0
MIN_BYTES_PER_S = 10_000
"""Minimum transfer rate; clients at this rate or above are never dropped as slow."""
NEAR, FAR = 0.8, 0.6
"""Fractions of the limit: a warning is logged above the first and re-armed below the second."""
RESERVED_DESCRIPTORS = 256
"""File descriptors reserved for the store, scene files, uploads and pipes of jobs."""
MAX_CLIENTS_LOGGED = 5
MAX_REASON_BYTES = 123
HARMLESS = (
    "ASGI callable returned without completing handshake.",
    "Invalid UTF-8 sequence received from client.",
)
"""Errors that uvicorn logs when a client leaves or is refused during the handshake, or sends text
that is not UTF-8. The client has received its reply; there is nothing to fix."""

log = structlog.get_logger(__name__)

_connection: ContextVar[Connection | None] = ContextVar("connection", default=None)
"""The connection whose bytes are being parsed; tasks of its requests inherit it."""


class DropReason(StrEnum):
    """Reasons for closing a connection."""

    HEAD_TIMEOUT = "head_timeout"
    BODY_TIMEOUT = "body_timeout"
    WRITE_TIMEOUT = "write_timeout"
    CROWDED_OUT = "crowded_out"
    REFUSED = "refused"


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of connections.

    Attributes:
        most: maximum number of connections.
        head_s: time from the first byte of a request, or from connecting, to the end of its
            headers.
        body_s: time for the body, in addition to that at the minimum rate.
        write_s: time for a client to read a reply, in addition to that at the minimum rate.
    """

    most: int
    head_s: float
    body_s: float
    write_s: float


class Connections:
    """All connections of a worker, for use on the event loop.

    Args:
        limits: number and timeouts.
        metrics: counts dropped connections.
    """

    def __init__(self, limits: ConnectionLimits, metrics: Metrics) -> None:
        self.limits = limits
        self._metrics = metrics
        self._open: set[Connection] = set()
        # Connections whose turn it is to send, longest silent first.
        self._silent: dict[Connection, None] = {}
        self._dropped: Counter[DropReason] = Counter()
        self._dropped_clients: list[str] = []
        self._warned = False
        metrics.watch(metrics.connections, lambda: len(self._open))
        metrics.connection_limit.set(limits.most)

    def __len__(self) -> int:
        return len(self._open)

    def admit(self, connection: Connection) -> None:
        """Register a new connection; it may be dropped immediately."""
        if len(self._open) >= self.limits.most:
            silent = next(iter(self._silent), None)
            if silent is None:
                self._drop(connection, DropReason.REFUSED)
                return
            self._drop(silent, DropReason.CROWDED_OUT)
        self._open.add(connection)
        self._silent[connection] = None
        self._warn_when_near()

    def await_client(self, connection: Connection) -> None:
        """Mark the client's turn to send: the connection may be dropped for a new one."""
        if connection in self._open:
            self._silent.pop(connection, None)
            self._silent[connection] = None

    def keep(self, connection: Connection) -> None:
        """Protect the connection while it is the worker's turn or a WebSocket is in use."""
        self._silent.pop(connection, None)

    def forget(self, connection: Connection) -> None:
        """Remove an ended connection."""
        self._open.discard(connection)
        self._silent.pop(connection, None)

    async def watch(self) -> None:
        """Drop overdue connections periodically, until cancelled."""
        while True:
            await asyncio.sleep(SWEEP_S)
            self.sweep()

    def sweep(self) -> None:
        """Drop overdue connections, and log the number dropped since the last call."""
        now = time.monotonic()
        for connection in list(self._open):
            if (reason := connection.overdue(now)) is not None:
                self._drop(connection, reason)
        if self._dropped:
            log.warning(
                "connections dropped",
                reasons={reason.value: count for reason, count in self._dropped.items()},
                clients=self._dropped_clients,
                open=len(self._open),
                limit=self.limits.most,
            )
            self._dropped.clear()
            self._dropped_clients = []

    def _drop(self, connection: Connection, reason: DropReason) -> None:
        # It counts as open until it ends, because a client that does not read keeps it open.
        self._silent.pop(connection, None)
        if reason is DropReason.CROWDED_OUT:
            self._open.discard(connection)
        self._dropped[reason] += 1
        self._metrics.dropped_connections.labels(reason.value).inc()
        client = connection.client[0] if connection.client else "unknown"
        if client not in self._dropped_clients and len(self._dropped_clients) < MAX_CLIENTS_LOGGED:
            self._dropped_clients.append(client)
        connection.drop(reason)

    def _warn_when_near(self) -> None:
        share = len(self._open) / self.limits.most
        if share >= NEAR and not self._warned:
            log.warning(
                "connections near their limit",
                open=len(self._open),
                limit=self.limits.most,
                hint="raise REAL2SIM_MAX_CONNECTIONS and the limit of descriptors (ulimit -n), "
                "or look for clients that leave connections open",
            )
        self._warned = share >= (FAR if self._warned else NEAR)


class Connection(asyncio.Protocol):
    """One connection of a client, served by uvicorn's protocol and watched by :class:`Connections`.

    Args:
        protocol: uvicorn's HTTP protocol.
        connections: connections of the worker.
    """

    def __init__(self, protocol: asyncio.Protocol, connections: Connections) -> None:
        self.client: tuple[str, int] | None = None
        self._protocol = protocol
        self._connections = connections
        self._backlog = Backlog(connections.limits.write_s)
        # When the client's turn to send began; None while it is the worker's.
        self._head_since: float | None = None
        # Bytes since then, and bytes after the request in progress.
        self.received = 0
        self._ahead = 0
        # While a request is in progress: seconds waited for its body, and the start of the current
        # wait.
        self._body_pending = False
        self._body_waited_s = 0.0
        self._body_since: float | None = None
        self._busy = False
        self._answering = False
        self._refused = False
        self._lost = asyncio.Event()

    # --- events of asyncio --------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take over a new connection."""
        self._transport = transport = cast(asyncio.Transport, transport)
        self._head_since = time.monotonic()
        peer = transport.get_extra_info("peername")
        if isinstance(peer, tuple):
            self.client = (peer[0], peer[1])
            if is_loopback(peer[0]):
                _send_unpaced(transport.get_extra_info("socket"))
        self._protocol.connection_made(_Transport(transport, self))  # type: ignore[arg-type]
        self._connections.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        self._lost.set()
        self._connections.forget(self)
        self._protocol.connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Data from the client."""
        if self._transport.is_closing():
            return
        if not self._busy:
            if self._head_since is None:
                self._head_since, self.received = time.monotonic(), 0
            self._connections.await_client(self)
        elif not self._body_pending:
            self._ahead += len(data)
        self.received += len(data)
        token = _connection.set(self)
        try:
            self._protocol.data_received(data)
        except (h11.LocalProtocolError, InvalidState):
            # There is no reply to bytes after a request in progress that are not HTTP, nor to text
            # that is not UTF-8 if a close frame follows it.
            self._transport.close()
        finally:
            _connection.reset(token)

    def eof_received(self) -> bool | None:
        """The client will send no more data."""
        return self._protocol.eof_received()

    def pause_writing(self) -> None:
        """The client reads more slowly than the worker sends."""
        self._protocol.pause_writing()

    def resume_writing(self) -> None:
        """The client has read most of the sent data."""
        self._backlog.cleared()
        self._protocol.resume_writing()

    def upgraded(self, protocol: asyncio.Protocol) -> None:
        """uvicorn's WebSocket protocol takes over the connection."""
        self._protocol, self._answering = protocol, True

    def may_write(self, data: bytes) -> bool:
        """Whether uvicorn may write ``data``.

        uvicorn refuses bad requests and handshakes in plain text. The client receives a problem
        document instead.
        """
        refusing = self._refused or data.startswith(b"HTTP/1.1 400 ")
        if self._answering or not refusing:
            return True
        if not self._refused:
            self._refused = True
            self._transport.write(bad_request_answer())
        return False

    # --- events of the application ------------------------------------------------------------

    async def serve_http(self, app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, and track whose turn it is."""
        self._head_since, self._busy, self._ahead = None, True, 0
        self._body_pending = _has_body(scope)
        self._body_waited_s = 0.0
        self._connections.keep(self)
        finished = False

        async def receive_noted() -> Message:
            if not self._body_pending:
                return await receive()
            self._body_since = began = time.monotonic()
            self._connections.await_client(self)
            try:
                message = await receive()
            finally:
                self._body_since = None
                self._body_waited_s += time.monotonic() - began
                self._connections.keep(self)
            self._body_pending = message.get("more_body", False)
            return message

        async def send_noted(message: Message) -> None:
            nonlocal finished
            self._answering = True
            if self._transport.is_closing():
                # uvicorn may have refused the body already. It ignores a reply once the
                # connection is lost.
                await self._lost.wait()
            await send(message)
            if message["type"] == "http.response.body" and not message.get("more_body"):
                finished = True
                self._request_finished()

        try:
            await app(scope, receive_noted, send_noted)
        finally:
            if not finished:
                self._request_finished()

    async def serve_websocket(
        self, app: ASGIApp, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """Serve a WebSocket, which is not dropped for a new connection after its first message."""
        self._head_since, self._busy, self._answering = None, True, True

        async def receive_noted() -> Message:
            message = await receive()
            if message["type"] == "websocket.receive":
                self._connections.keep(self)
            return message

        await app(scope, receive_noted, send)

    def _request_finished(self) -> None:
        self._busy = self._answering = self._body_pending = False
        if self._ahead:  # The client has begun to send the next request.
            self._head_since, self.received = time.monotonic(), self._ahead
        self._connections.await_client(self)

    # --- queries of the sweep -----------------------------------------------------------------

    def overdue(self, now: float) -> DropReason | None:
        """The reason to drop the connection, or None; ``now`` in seconds, monotonic clock."""
        limits = self._connections.limits
        if self._backlog.overdue(self._transport, now):
            return DropReason.WRITE_TIMEOUT
        if self._transport.is_closing():
            return None
        if self._head_since is not None and now - self._head_since > limits.head_s:
            return DropReason.HEAD_TIMEOUT
        if self._body_since is not None:
            waited = self._body_waited_s + now - self._body_since
            if waited > limits.body_s + self.received / MIN_BYTES_PER_S:
                return DropReason.BODY_TIMEOUT
        return None

    def drop(self, reason: DropReason) -> None:
        """Close the connection; send a reply if a request has begun and none is in progress."""
        transport = self._transport
        if reason is DropReason.WRITE_TIMEOUT or transport.get_write_buffer_size():
            transport.abort()
            return
        begun = self._busy or (self._head_since is not None and self.received)
        if (begun or reason is DropReason.REFUSED) and not self._answering:
            transport.write(last_answer(reason, self._connections.limits))
        transport.close()


class _Transport:
    """The transport for uvicorn's protocols; keeps the watch when the protocol changes."""

    def __init__(self, transport: asyncio.Transport, connection: Connection) -> None:
        self._transport = transport
        self._connection = connection
        self.set_protocol = connection.upgraded

    def write(self, data: bytes) -> None:
        if self._connection.may_write(data):
            self._transport.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)


def watch(config: uvicorn.Config, connections: Connections) -> None:
    """Watch all of uvicorn's connections with ``connections``."""
    logging.getLogger("uvicorn.error").addFilter(_is_news)
    config.app = _noted(config.app)  # type: ignore[arg-type]
    config.load()
    protocol = config.http_protocol_class
    config.http_protocol_class = lambda **options: Connection(protocol(**options), connections)  # type: ignore[assignment]


def _is_news(record: logging.LogRecord) -> bool:
    return record.msg not in HARMLESS


def _noted(app: ASGIApp) -> ASGIApp:
    """Wrap ``app`` to report each request to its connection."""

    async def served(scope: Scope, receive: Receive, send: Send) -> None:
        connection = _connection.get()
        if connection is None:  # the lifespan
            await app(scope, receive, send)
        elif scope["type"] == "http":
            await connection.serve_http(app, scope, receive, send)
        else:
            await connection.serve_websocket(app, scope, receive, send)

    return served


def _has_body(scope: Scope) -> bool:
    """Whether a request declares a body (RFC 9112, 6)."""
    headers = dict(scope["headers"])
    return b"transfer-encoding" in headers or headers.get(b"content-length", b"0") != b"0"


class Backlog:
    """Unread data of a client, as observed by the sweep.

    Args:
        allowed_s: maximum time below :data:`MIN_BYTES_PER_S`.
    """

    def __init__(self, allowed_s: float) -> None:
        self._allowed_s = allowed_s
        self._since = 0.0
        self._bytes = 0
        self._read = 0

    def overdue(self, transport: asyncio.Transport, now: float) -> bool:
        """Whether the client reads too slowly, or not at all."""
        size = transport.get_write_buffer_size()
        if self._bytes == 0:
            self._since, self._read = now, 0
        self._read += max(0, self._bytes - size)
        self._bytes = size
        return size > 0 and now - self._since > self._allowed_s + self._read / MIN_BYTES_PER_S

    def cleared(self) -> None:
        """The client has read everything above the transport's low-water mark."""
        self._bytes = 0


async def receive_text(websocket: WebSocket) -> str:
    """The next message, which must be text.

    Raises:
        WebSocketDisconnect: the client has disconnected.
        ServiceError: BAD_MESSAGE, the message is binary.
    """
    event = await websocket.receive()
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event.get("code", 1005))
    text = event.get("text")
    if text is None:
        raise ServiceError(ErrorCode.BAD_MESSAGE, "bytes were sent where messages are JSON text")
    return str(text)


async def close_quietly(websocket: WebSocket, code: int, reason: str) -> None:
    """Close a socket, unless the client has left."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        await websocket.close(code, close_reason(reason))


def close_reason(text: str) -> str:
    """``text`` truncated to the size of a close frame: 123 bytes (RFC 6455, 5.5)."""
    return text.encode("utf-8", "replace")[:MAX_REASON_BYTES].decode("utf-8", "ignore")


def connection_limit(wanted: int) -> int:
    """Number of connections within the limit of file descriptors, at most ``wanted``."""
    try:
        import resource
    except ImportError:  # not available on this system
        return wanted
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return wanted
    return min(wanted, max(soft - RESERVED_DESCRIPTORS, soft // 4, 1))


def last_answer(reason: DropReason, limits: ConnectionLimits) -> bytes:
    """The complete HTTP reply to send before the connection is closed."""
    failure = _FAILURES[reason](limits)
    problem = problem_of(failure, path="", request_id=None)
    body = json.dumps(problem.model_dump(mode="json", exclude_none=True)).encode()
    return _whole_answer(failure, body)


def bad_request_answer() -> bytes:
    """A complete HTTP reply to data that is not HTTP or not a valid handshake."""
    failure = ServiceError(
        ErrorCode.BAD_MESSAGE,
        "the bytes sent are neither an HTTP/1.1 request nor a WebSocket handshake of version 13",
    )
    problem = problem_of(failure, path="", request_id=None)
    return _whole_answer(failure, problem.model_dump_json(exclude_none=True).encode())


def _whole_answer(failure: ServiceError, body: bytes) -> bytes:
    phrase = {400: "Bad Request", 408: "Request Timeout", 503: "Service Unavailable"}
    headers = {
        "Content-Type": PROBLEM_MEDIA_TYPE,
        "Content-Length": str(len(body)),
        "Connection": "close",
        **failure.headers,
        **SECURITY_HEADERS,
    }
    status = HTTP_STATUS[failure.code]
    lines = [f"HTTP/1.1 {status} {phrase[status]}", *(f"{k}: {v}" for k, v in headers.items())]
    return "\r\n".join([*lines, "", ""]).encode() + body


def _crowded(limits: ConnectionLimits) -> ServiceError:
    return ServiceError(
        ErrorCode.TOO_MANY_CONNECTIONS,
        f"all {limits.most} connections of this worker are taken",
        hint="send it again after Retry-After seconds, and use one connection for many requests",
    )


_FAILURES = {
    DropReason.HEAD_TIMEOUT: lambda limits: ServiceError(
        ErrorCode.REQUEST_TIMEOUT,
        f"the headers of the request were not complete within {limits.head_s:g} s",
        hint="send a request whole",
    ),
    DropReason.BODY_TIMEOUT: lambda limits: ServiceError(
        ErrorCode.REQUEST_TIMEOUT,
        f"the body came more slowly than {MIN_BYTES_PER_S} bytes a second, and "
        f"{limits.body_s:g} s more",
        hint="send it again, whole",
    ),
    DropReason.CROWDED_OUT: _crowded,
    DropReason.REFUSED: _crowded,
}


def _send_unpaced(connection: socket.socket) -> None:
    """Disable TCP pacing on loopback.

    The pacing timer runs for every 64 kB, which adds 0.1 ms for three images.
    """
    if hasattr(socket, "TCP_CONGESTION"):
        # Every Linux kernel includes Reno, and every process may select it.
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"reno")
