"""HTTP/1.1 with an end to waiting: for headers, for bodies, and for clients that do not read."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from .connections import (
    SLOWEST_BYTES_PER_S,
    Backlog,
    Connections,
    DropReason,
    bad_request_answer,
    last_answer,
)


class LimitedHttpProtocol(H11Protocol):
    """uvicorn's protocol, watched by the connections of a worker.

    Args:
        connections: of the worker.
        options: of uvicorn's protocol.
    """

    def __init__(self, connections: Connections, **options: Any) -> None:
        super().__init__(**options)
        self._watch = connections
        self._backlog = Backlog(connections.limits.write_s)
        # None while no headers, or no body, are waited for.
        self._head_since: float | None = None
        self._body_since: float | None = None
        self._received = 0
        self._swept_at = 0.0
        self._upgraded = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take over a new connection."""
        super().connection_made(transport)  # type: ignore[arg-type]
        self._head_since = time.monotonic()
        self._watch.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        self._watch.forget(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Bytes of a client."""
        if self.transport.is_closing():
            return
        if self._head_since is None and self.conn.their_state is h11.IDLE:
            self._head_since, self._received = time.monotonic(), 0
        self._received += len(data)
        super().data_received(data)
        self._note_turn()

    def on_response_complete(self) -> None:
        """The answer is written whole."""
        super().on_response_complete()
        if self.conn.their_state is h11.IDLE and (begun := self.conn.trailing_data[0]):
            self._head_since, self._received = time.monotonic(), len(begun)
        self._note_turn()

    def resume_writing(self) -> None:
        """The client has read most of what it was sent."""
        self._backlog.cleared()
        super().resume_writing()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Leave the connection to the protocol of sockets."""
        self._upgraded = True
        self._watch.forget(self)
        super().handle_websocket_upgrade(event)

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP."""
        if not self._answering:
            self.transport.write(bad_request_answer())
        self.transport.close()

    def overdue(self, now: float) -> DropReason | None:
        """Why this connection has to go, if it has to."""
        limits, swept_at = self._watch.limits, self._swept_at
        self._swept_at = now
        if self._backlog.overdue(self.transport, now):
            return DropReason.WRITE_TIMEOUT
        if self.transport.is_closing():
            return None
        if self._head_since is not None and now - self._head_since > limits.head_s:
            return DropReason.HEAD_TIMEOUT
        if self._body_since is not None:
            if self.flow.read_paused:  # the worker is not ready for more, the client has no part
                self._body_since += now - max(swept_at, self._body_since)
            allowed = limits.body_s + self._received / SLOWEST_BYTES_PER_S
            if now - self._body_since > allowed:
                return DropReason.BODY_TIMEOUT
        return None

    def drop(self, reason: DropReason) -> None:
        """Close the connection, with an answer where a request has begun and none is under way."""
        if reason is DropReason.WRITE_TIMEOUT or self.transport.get_write_buffer_size():
            self.transport.abort()
            return
        begun = self._body_since is not None or (self._head_since is not None and self._received)
        if (begun or reason is DropReason.REFUSED) and not self._answering:
            self.transport.write(last_answer(reason, self._watch.limits))
        self.transport.close()

    @property
    def _answering(self) -> bool:
        cycle = self.cycle
        return cycle is not None and cycle.response_started and not cycle.response_complete

    def _note_turn(self) -> None:
        """Whether headers or a body are waited for now."""
        if self._upgraded:
            return
        state = self.conn.their_state
        if state is not h11.IDLE:
            self._head_since = None
        if state is not h11.SEND_BODY:
            self._body_since = None
        elif self._body_since is None:
            self._body_since = time.monotonic()
        self._watch.heard(self, more=state is h11.IDLE or state is h11.SEND_BODY)
