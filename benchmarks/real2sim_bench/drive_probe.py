"""A lean WebSocket client for drive sessions, with little overhead in measurements.

It uses one thread and reads each message directly from the socket. The websockets library only does
the handshake and the close. Messages are masked with zeros, which leaves them unchanged.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self, cast
from urllib.parse import urlsplit

from websockets.client import ClientProtocol
from websockets.frames import Opcode
from websockets.protocol import State
from websockets.typing import Subprotocol
from websockets.uri import parse_uri

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_proto.sessions import SessionInfo

READ = 1 << 16
STALLED_S = 60.0
"""Timeout for the next part of a message [s]."""
LENGTHS = {126: 2, 127: 8}
"""Bytes of the extended payload length, by the length field of the header (RFC 6455, 5.2)."""
LAST, OPCODE, LENGTH = 0x80, 0x0F, 0x7F
MASKED, NO_MASK = 0x80, bytes(4)


class LeanSocket:
    """A WebSocket connection, for use in a ``with`` block. Servers must neither mask nor compress.

    Args:
        url: ws://host:port/path.
        subprotocol: requested subprotocol.

    Raises:
        OSError: the connection fails.
        websockets.exceptions.InvalidHandshake: the server rejects the handshake.
    """

    def __init__(self, url: str, *, subprotocol: str) -> None:
        self._protocol = ClientProtocol(
            parse_uri(url), subprotocols=[Subprotocol(subprotocol)], max_size=None
        )
        address = urlsplit(url)
        self.socket = socket.create_connection((address.hostname, address.port or 80))
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffered = b""
        self._timeout_s: float | None = None
        try:
            self._handshake()
        except BaseException:
            self.socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection without waiting for the server's close frame."""
        self._protocol.send_close(1000)
        with contextlib.suppress(OSError):  # The server may have closed the connection first.
            self._flush()
        self.socket.close()

    def send(self, message: bytes) -> None:
        """Send a binary message."""
        self.socket.sendall(_head(len(message)) + message)

    def recv(self, timeout_s: float) -> bytes | bytearray:
        """Receive the next message; pings are answered.

        Args:
            timeout_s: timeout for the start of a message [s].

        Raises:
            TimeoutError: no message started; later messages can still be read.
            ConnectionError: the server closed the connection, or stopped within a message.
        """
        while True:
            opcode, payload = self._message(timeout_s)
            if opcode in {Opcode.BINARY, Opcode.TEXT}:
                return payload

    def ping(self, timeout_s: float) -> float:
        """Seconds until a ping is answered. Raises like :meth:`recv`."""
        started = time.perf_counter()
        self._protocol.send_ping(b"")
        self._flush()
        while self._message(timeout_s)[0] != Opcode.PONG:
            pass
        return time.perf_counter() - started

    def _handshake(self) -> None:
        self._protocol.send_request(self._protocol.connect())
        self._flush()
        while self._protocol.state is State.CONNECTING and self._protocol.handshake_exc is None:
            # Byte by byte, because the first message may follow the handshake immediately.
            self._protocol.receive_data(self._read(1))
        if self._protocol.handshake_exc is not None:
            raise self._protocol.handshake_exc

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            self.socket.sendall(data)

    def _message(self, timeout_s: float) -> tuple[int, bytes | bytearray]:
        """Opcode and payload of the next message, with its frames joined."""
        if not self._buffered:
            self._wait_at_most(timeout_s)
            self._buffered = self._read(READ)
        try:
            opcode, payload = self._whole() or self._frames()
        except TimeoutError as error:
            raise ConnectionError("the server stopped within a message") from error
        if opcode == Opcode.PING:
            self._protocol.send_pong(bytes(payload))
            self._flush()
        elif opcode == Opcode.CLOSE:
            raise ConnectionError(f"the server closed the connection: {bytes(payload[2:])!r}")
        return opcode, payload

    def _wait_at_most(self, timeout_s: float) -> None:
        """Set the socket timeout; skips the system call if it is unchanged."""
        if timeout_s != self._timeout_s:
            self.socket.settimeout(timeout_s)
            self._timeout_s = timeout_s

    def _whole(self) -> tuple[int, bytes] | None:
        """The next message if it is complete in the buffer, in one frame; else None."""
        found, begin = self._buffered, 2
        if len(found) < begin or not found[0] & LAST:
            return None
        size = found[1] & LENGTH
        if size in LENGTHS:
            begin += LENGTHS[size]
            size = int.from_bytes(found[2:begin], "big")
        if len(found) < begin + size:
            return None
        self._buffered = found[begin + size :]
        return found[0] & OPCODE, found[begin : begin + size]

    def _frames(self) -> tuple[int, bytes | bytearray]:
        self._wait_at_most(STALLED_S)
        header, opcode, payload = 0, 0, bytearray()
        while not header & LAST:
            header, length = self._exactly(2)
            size = length & LENGTH
            if size in LENGTHS:
                size = int.from_bytes(self._exactly(LENGTHS[size]), "big")
            opcode = opcode or header & OPCODE
            part = self._exactly(size)
            payload = payload + part if payload else part
        return opcode, payload

    def _exactly(self, size: int) -> bytearray:
        data = bytearray(size)
        view, filled = memoryview(data), min(size, len(self._buffered))
        view[:filled], self._buffered = self._buffered[:filled], self._buffered[filled:]
        while filled < size:
            if size - filled >= READ:
                count = self.socket.recv_into(view[filled:])
                if not count:
                    raise ConnectionError("the server is gone")
            else:
                read = self._read(READ)
                count = min(len(read), size - filled)
                view[filled : filled + count], self._buffered = read[:count], read[count:]
            filled += count
        return data

    def _read(self, size: int) -> bytes:
        read = self.socket.recv(size)
        if not read:
            raise ConnectionError("the server is gone")
        return read


def _head(size: int) -> bytes:
    """Header of a frame with a whole binary message, masked with zeros."""
    first = LAST | Opcode.BINARY
    if size < min(LENGTHS):
        return bytes([first, MASKED | size]) + NO_MASK
    length = next(n for n in LENGTHS if size < 1 << 8 * LENGTHS[n])
    return bytes([first, MASKED | length]) + size.to_bytes(LENGTHS[length], "big") + NO_MASK


# Drive sessions.

ANSWER_S = 60.0
SPEED = 8.0
PLAN_POSES = 20
PLAN_PERIOD_US = 100_000
AHEAD_US = [k * PLAN_PERIOD_US for k in range(1, PLAN_POSES + 1)]
POSES = [[SPEED * us * 1e-6, 0.0, 0.0] for us in AHEAD_US]


class DriveProbe:
    """Controls a session with hand-made messages, for use in a ``with`` block.

    Pings are only answered while a message is read, so read before the worker times out.

    Args:
        info: the session.
        resume: resume token of an earlier connection, and the step of its last observation.

    Attributes:
        socket: connection to the worker.
        resume_token: token to resume the session with another connection.
        pushed: the last unrequested observation, or None.
    """

    def __init__(self, info: SessionInfo, *, resume: tuple[str, int] | None = None) -> None:
        self._info = info
        self._resume = resume
        self._id = 0
        self.resume_token = ""
        self.pushed: dict[str, Any] | None = None

    def __enter__(self) -> Self:
        self.socket = LeanSocket(self._info.ws_url, subprotocol=DRIVE_SUBPROTOCOL)
        hello: dict[str, Any] = {
            "type": "hello",
            "protocols": [DRIVE_SUBPROTOCOL],
            "token": self._info.token,
        }
        if self._resume is not None:
            token, step = self._resume
            hello["resume"] = {"token": token, "last_step": step}
        try:
            self.resume_token = self._accepted(hello)[0]["resume_token"]
        except BaseException:
            self.socket.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.socket.close()

    def reset(
        self, sensors: Sequence[Mapping[str, Any]], *, dt_us: int, **spec: Any
    ) -> tuple[dict[str, Any], float]:
        """Start an episode; returns its first observation and the elapsed time [s]."""
        fields = {"dt_us": dt_us, "sensors": list(sensors), **spec}
        return self._accepted({"type": "reset", "spec": fields})

    def act(self, obs: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        """Drive straight on; returns the next observation and the time until its arrival [s]."""
        return self._accepted(action(obs))

    def send(self, fields: Mapping[str, Any]) -> None:
        """Send a message without waiting for a reply."""
        self._id += 1
        self.socket.send(encode({"v": 1, "id": self._id, **fields}))

    def ask(self, fields: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        """Send a message; returns the reply, which may be an error, and the elapsed time [s]."""
        started = time.perf_counter()
        self.send(fields)
        while True:
            received = self.socket.recv(ANSWER_S)
            seconds = time.perf_counter() - started
            answer = decode(cast("bytes", received))
            if answer["type"] == "obs" and answer["id"] == 0:
                self.pushed = answer
            elif answer["type"] != "progress":
                return answer, seconds

    def listen(self, seconds: float, *, until_pushed: float = 0.0) -> None:
        """Receive unrequested messages for ``seconds``; if none arrives, wait up to
        ``until_pushed`` seconds for one."""
        self.pushed, started = None, time.monotonic()
        while True:
            wanted = until_pushed if self.pushed is None else seconds
            left = started + max(wanted, seconds) - time.monotonic()
            if left <= 0:
                return
            with contextlib.suppress(TimeoutError):
                answer = decode(cast("bytes", self.socket.recv(left)))
                if answer["type"] == "obs":
                    self.pushed = answer

    def _accepted(self, fields: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        answer, seconds = self.ask(fields)
        if answer["type"] == "error":
            raise RuntimeError(f"the worker refused {fields['type']}: {answer['detail']}")
        return answer, seconds


def action(obs: Mapping[str, Any]) -> dict[str, Any]:
    """Action that drives straight on after an observation."""
    return {"type": "action", "step": obs["step"], "plan": straight_on(obs["t_us"])}


def straight_on(t_us: int) -> dict[str, Any]:
    """A trajectory plan over the next two seconds."""
    poses = [list(pose) for pose in POSES]  # Some planners modify the plan, so return a copy.
    return {"kind": "trajectory", "times_us": [t_us + us for us in AHEAD_US], "poses": poses}
