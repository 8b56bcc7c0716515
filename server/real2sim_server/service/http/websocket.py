"""WebSocket connections that are watched, and unpaced on loopback."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Sequence
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.protocol import State

from real2sim_proto import ErrorCode

from .auth import is_loopback
from .connections import Backlog, Connections, DropReason
from .problems import ServiceError

MAX_REASON_BYTES = 123
CLOSED_NO_UTF8 = 1007
"""Code that RFC 6455, 7.4.1, has for text that is none."""


async def receive_text(websocket: WebSocket) -> str:
    """The next message, where messages are text.

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
    """Close a socket, unless its client has left."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        await websocket.close(code, close_reason(reason))


def close_reason(text: str) -> str:
    """As much of ``text`` as a close frame holds: 123 bytes (RFC 6455, 5.5)."""
    return text.encode("utf-8", "replace")[:MAX_REASON_BYTES].decode("utf-8", "ignore")


class WatchedWebSocketProtocol(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket protocol, watched by the connections of a worker.

    Args:
        connections: of the worker; they watch this one.
        options: of uvicorn's protocol.
    """

    def __init__(self, connections: Connections, **options: Any) -> None:
        super().__init__(**options)
        self._watch = connections
        self._backlog = Backlog(connections.limits.write_s)
        self._has_spoken = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take over a connection on which a handshake has begun."""
        super().connection_made(transport)
        self._watch.admit(self)
        if self.client is not None and is_loopback(self.client[0]):
            _send_unpaced(transport.get_extra_info("socket"))

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        self._watch.forget(self)
        super().connection_lost(exc)

    def resume_writing(self) -> None:
        """The client has read most of what it was sent."""
        self._backlog.cleared()
        super().resume_writing()

    async def send(self, message: Any) -> None:
        """Send one message, unless the connection is ending by what the client did."""
        if self.transport.is_closing():
            raise ClientDisconnected
        await super().send(message)

    async def run_asgi(self) -> None:
        """Serve the connection; one that was answered by HTTP, or has left, is no error."""
        app = self.app

        async def served(*asgi: Any) -> None:
            await app(*asgi)
            self.handshake_complete |= self.transport.is_closing()

        self.app = served
        await super().run_asgi()

    def send_receive_event_to_app(self) -> None:
        """A message is whole; from the first on, the connection gives way to no other."""
        if not self._has_spoken:
            self._has_spoken = True
            self._watch.heard(self, more=False)
        if self.curr_msg_data_type == "text" and not _is_utf8(self.frames):
            # Refused here: the base class would write a traceback for each.
            self.frames = []
            if self.conn.state is State.OPEN:
                self.conn.send_close(CLOSED_NO_UTF8)
                self.handle_parser_exception()
            return
        super().send_receive_event_to_app()

    def overdue(self, now: float) -> DropReason | None:
        """Why this connection has to go, if it has to: pings and the handshake end other waits."""
        return DropReason.WRITE_TIMEOUT if self._backlog.overdue(self.transport, now) else None

    def drop(self, reason: DropReason) -> None:
        """End the connection."""
        self.transport.abort()


def _is_utf8(parts: Sequence[bytes]) -> bool:
    try:
        b"".join(parts).decode()
    except UnicodeDecodeError:
        return False
    return True


def _send_unpaced(connection: socket.socket) -> None:
    """Where the system's congestion control paces what it sends, a timer runs for every 64 kB: a
    tenth of a millisecond for three images that never leave the machine."""
    if hasattr(socket, "TCP_CONGESTION"):
        # Reno is part of every Linux and open to every process.
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"reno")
