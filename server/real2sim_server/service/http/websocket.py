"""WebSocket connections of megabytes a message: scatter-gather sends, unpaced on loopback.

ASGI knows messages of one piece only; servers may offer more as an extension of it. Where a server
does not offer this one, or the client is slow to read, the parts are joined and sent as ever.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Sequence
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame, Opcode
from websockets.http11 import Request
from websockets.protocol import State

from real2sim_proto import ErrorCode

try:
    from websockets.speedups import apply_mask
except ImportError:  # Built without its extension in C.
    from websockets.utils import apply_mask

from .connections import Backlog, Connections, DropReason
from .hosts import is_loopback
from .problems import ServiceError

Part = bytes | memoryview

EXTENSION = "websocket.send_parts"
"""Holds a function that writes the parts of a binary message, or returns False."""

TAKING = "websocket.take_messages"
"""Holds a function that is told who may take binary messages in the very call that has read them,
see :func:`let_take`."""

Taker = Callable[[bytes], bool]
"""Takes a binary message, or returns False: then it comes by ``receive``, as all others do."""

JOINED_BYTES = 16_384
"""Messages up to this size are written in one piece: that takes less than to gather their parts."""

MAX_REASON_BYTES = 123
FIN = 0x80
CLOSED_NO_UTF8 = 1007
"""Code that RFC 6455, 7.4.1, has for text that is none."""
SHORT, LONG = 126, 127
"""Stand for a length of 2 and of 8 bytes behind the first two of a frame (RFC 6455, 5.2)."""
MASKED, MASK_BYTES = 0x80, 4
NO_MASK = bytes(MASK_BYTES)


async def send_parts(websocket: WebSocket, parts: Sequence[Part]) -> None:
    """Send one binary message. Raises WebSocketDisconnect once the client has disconnected."""
    if websocket.application_state is WebSocketState.DISCONNECTED:
        raise WebSocketDisconnect
    if not try_send_parts(websocket, parts):
        await websocket.send_bytes(b"".join(parts))


def try_send_parts(websocket: WebSocket, parts: Sequence[Part]) -> bool:
    """Write one binary message if nothing has to be waited for; whether it is written.

    On the event loop.
    """
    send = websocket.scope.get("extensions", {}).get(EXTENSION)
    return send is not None and bool(send(parts))


def let_take(websocket: WebSocket, taker: Taker) -> None:
    """Let ``taker`` have each binary message of one frame before anybody who awaits one, as long as
    none waits to be received; for connections of servers that offer this. It must not raise.
    """
    offer = websocket.scope.get("extensions", {}).get(TAKING)
    if offer is not None:
        offer(taker)


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


class ScatterGatherProtocol(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket protocol with that extension, for connections without compression.

    Args:
        connections: of the worker; they watch this one.
        options: of uvicorn's protocol.
    """

    def __init__(self, connections: Connections, **options: Any) -> None:
        super().__init__(**options)
        self._watch = connections
        self._backlog = Backlog(connections.limits.write_s)
        self._has_spoken = False
        self._taker: Taker | None = None
        self._unparsed = 0

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

    def handle_connect(self, event: Request) -> None:
        """Offer the extension in the scope of an accepted connection."""
        super().handle_connect(event)
        if not self.close_sent and not self.config.ws_per_message_deflate:
            extensions: dict[str, Any] = self.scope["extensions"]
            extensions[EXTENSION] = self._send_parts
            extensions[TAKING] = self._let_take

    def data_received(self, data: bytes) -> None:
        """Bytes of the client, most often one message that is taken."""
        if not self.handshake_initiated:
            # The request, whole and alone: the server has read it before.
            super().data_received(data)
            return
        if self._taker is not None and not self._unparsed and self._is_whole_and_taken(data):
            return
        self._unparsed += len(data)
        super().data_received(data)

    def handle_events(self) -> None:
        """Frames are whole, and no longer waited for."""
        # None is longer than it has to be, so what is left is 0 between two frames only.
        self._unparsed -= sum(_frame_size(e) for e in self.conn.events if isinstance(e, Frame))
        super().handle_events()

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
        if not self._is_taken():
            super().send_receive_event_to_app()

    def overdue(self, now: float) -> DropReason | None:
        """Why this connection has to go, if it has to: pings and the handshake end other waits."""
        return DropReason.WRITE_TIMEOUT if self._backlog.overdue(self.transport, now) else None

    def drop(self, reason: DropReason) -> None:
        """End the connection."""
        self.transport.abort()

    def _let_take(self, taker: Taker) -> None:
        self._taker = taker

    def _is_taken(self) -> bool:
        """Whether the message that is whole now needs no task that awaits it."""
        if self._taker is None or self.curr_msg_data_type != "bytes" or len(self.frames) != 1:
            return False
        if self.close_sent or not self.queue.empty() or not self._taker(self.frames[0]):
            return False
        self.frames = []
        return True

    def _is_whole_and_taken(self, data: bytes) -> bool:
        """Whether ``data``, which begins with a frame, is one binary message and is taken: then the
        protocol need not know of it. It would read it in a dozen steps."""
        assert self._taker is not None
        payload = _whole_message(data)
        if payload is None or self.close_sent or self.conn.state is not State.OPEN:
            return False
        # Within a message of several frames another one is an error.
        if self.conn.current_size is not None or not self.queue.empty():
            return False
        return self._taker(payload)

    def _send_parts(self, parts: Sequence[Part]) -> bool:
        """Write one binary message, if nothing has to be waited for."""
        if self.disconnected or self.conn.state is not State.OPEN or not self.writable.is_set():
            return False
        size = sum(map(len, parts))
        framed = (_header(size), *parts)
        if size <= JOINED_BYTES:
            self.transport.write(b"".join(framed))
        else:
            self.transport.writelines(framed)
        return True


def _is_utf8(parts: Sequence[bytes]) -> bool:
    try:
        b"".join(parts).decode()
    except UnicodeDecodeError:
        return False
    return True


def _whole_message(data: bytes) -> bytes | None:
    """The binary message that a client has sent as these bytes; None for anything else, and where
    it is so large that it does not matter."""
    if len(data) < 2 + MASK_BYTES or data[0] != FIN | Opcode.BINARY or not data[1] & MASKED:
        return None
    size, begin = data[1] & ~MASKED, 2
    if size == SHORT:
        size, begin = int.from_bytes(data[2:4], "big"), 4
    if (size >= LONG and begin == 2) or len(data) != begin + MASK_BYTES + size:
        return None
    mask, payload = data[begin : begin + MASK_BYTES], data[begin + MASK_BYTES :]
    return payload if mask == NO_MASK else bytes(apply_mask(payload, mask))


def _frame_size(frame: Frame) -> int:
    """Bytes of a client's frame, its length written in as few as it can be."""
    size = len(frame.data)
    return 2 + (0 if size < SHORT else 2 if size < 1 << 16 else 8) + MASK_BYTES + size


def _header(size: int) -> bytes:
    """Of an unmasked frame that is a whole binary message."""
    first = FIN | Opcode.BINARY
    if size < SHORT:
        return bytes([first, size])
    if size < 1 << 16:
        return bytes([first, SHORT]) + size.to_bytes(2, "big")
    return bytes([first, LONG]) + size.to_bytes(8, "big")


def _send_unpaced(connection: socket.socket) -> None:
    """Where the system's congestion control paces what it sends, a timer runs for every 64 kB: a
    tenth of a millisecond for three images that never leave the machine."""
    if hasattr(socket, "TCP_CONGESTION"):
        # Reno is part of every Linux and open to every process.
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"reno")
