"""A lean WebSocket client for drive sessions, which measures the worker and not its client.

It uses one thread and reads each message directly from the socket. The websockets library only does
the handshake and the close; messages are masked with zeros, which leaves them unchanged.
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
"""A message whose next part does not come within this time never will."""
LENGTHS = {126: 2, 127: 8}
"""Bytes of a payload's length behind a header that holds one of these numbers (RFC 6455, 5.2)."""
LAST, OPCODE, LENGTH = 0x80, 0x0F, 0x7F
MASKED, NO_MASK = 0x80, bytes(4)


class LeanSocket:
    """Use it in a ``with`` block; it speaks to servers that neither mask nor compress.

    Args:
        url: ws://host:port/path.
        subprotocol: to ask for.

    Raises:
        OSError: nobody listens there.
        websockets.exceptions.InvalidHandshake: the server refuses.
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
        """Leave; the server's own goodbye is not waited for."""
        self._protocol.send_close(1000)
        with contextlib.suppress(OSError):  # The server may have been the first to go.
            self._flush()
        self.socket.close()

    def send(self, message: bytes) -> None:
        """One binary message."""
        self.socket.sendall(_head(len(message)) + message)

    def recv(self, timeout_s: float) -> bytes | bytearray:
        """The next message as it came; pings on the way are answered.

        Args:
            timeout_s: to wait for something to come; a message that has begun is waited for.

        Raises:
            TimeoutError: nothing came; what comes later can still be read.
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
            # Byte by byte, for the first message may follow the handshake at once.
            self._protocol.receive_data(self._read(1))
        if self._protocol.handshake_exc is not None:
            raise self._protocol.handshake_exc

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            self.socket.sendall(data)

    def _message(self, timeout_s: float) -> tuple[int, bytes | bytearray]:
        """Opcode and payload of the next message, its frames put together."""
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
        """A call of the system, spared where nothing changes."""
        if timeout_s != self._timeout_s:
            self.socket.settimeout(timeout_s)
            self._timeout_s = timeout_s

    def _whole(self) -> tuple[int, bytes] | None:
        """The next message where all of it has come in one frame, as small ones do."""
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
    """Of a frame that is a whole binary message, masked by zeros."""
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
    """Controls a session by messages made by hand; use it in a ``with`` block.

    Pings are answered with the next message that is read, so read before the worker gives up.

    Args:
        info: of the session.
        resume: of an earlier connection that this one goes on for: its resume token, and the step
            of the last observation it has.

    Attributes:
        socket: to the worker.
        resume_token: with which a further connection may go on.
        pushed: the last observation that nobody has asked for; None for none.
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
        """Begin an episode; its first observation and the seconds it took."""
        fields = {"dt_us": dt_us, "sensors": list(sensors), **spec}
        return self._accepted({"type": "reset", "spec": fields})

    def act(self, obs: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        """Drive straight on; the next observation and the seconds until its bytes were here."""
        return self._accepted(action(obs))

    def send(self, fields: Mapping[str, Any]) -> None:
        """Send a message and wait for nothing."""
        self._id += 1
        self.socket.send(encode({"v": 1, "id": self._id, **fields}))

    def ask(self, fields: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
        """The answer to a message, be it an error, and the seconds it took."""
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
        """Take what comes unasked for so long, and on until something came, if that takes less
        than ``until_pushed`` seconds."""
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
    """Straight on after an observation."""
    return {"type": "action", "step": obs["step"], "plan": straight_on(obs["t_us"])}


def straight_on(t_us: int) -> dict[str, Any]:
    """A trajectory plan over the next two seconds."""
    poses = [list(pose) for pose in POSES]  # A copy: some planners change it.
    return {"kind": "trajectory", "times_us": [t_us + us for us in AHEAD_US], "poses": poses}
