"""Clients that send mutated messages to the drive and view sockets."""

from __future__ import annotations

import base64
import contextlib
import json
import random
import socket
import struct
import time
from typing import Any

import mutation
from attacked_site import DEAD_S, SENSOR, TOKEN, Site

from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode

TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
LIMIT = 1 << 20
QUIET_S = 0.03
"""Timeout for the answer to bytes that may not be a frame [s]."""
ODD_TEXTS = (
    "", "{", "[]", "7", "null", '{"type":"hello","token":"\\ud800"}', "[" * 100_000, "\x00",
    '{"a":' * 50_000, '{"type":"hello","token":' + "9" * 5000 + "}", '"\\u0000"', "\U0010ffff",
    '{"t_us":NaN}', '{"t_us":1e999}', '{"seq":99999999999999999999}',
)  # fmt: skip
ODD_BYTES = (
    b"", b"\xc1", b"\x80", b"\x91" * 100_000, b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc7\xff\x01" + b"\x00" * 255,
    b"\x81\xa1v\xcf" + b"\xff" * 8, b"\x81\xa4type\xa3\xed\xa0\x80", b"\x82\xa1v\x01\xa1v\x01",
    b"\x81\xa4type" * 3, encode({"v": 2, "type": "hello"}), encode({"type": "hello", "id": -1}),
)  # fmt: skip


def frame(kind: int, data: bytes, *, last: bool = True, flags: int = 0) -> bytes:
    """A masked client frame (RFC 6455, 5.2)."""
    first = (0x80 if last else 0) | flags | kind
    n = len(data)
    if n < 126:
        head = struct.pack("!BB", first, 0x80 | n)
    elif n < 1 << 16:
        head = struct.pack("!BBH", first, 0xFE, n)
    else:
        head = struct.pack("!BBQ", first, 0xFF, n)
    return head + b"\x00\x00\x00\x00" + data


class Left(Exception):
    """The worker has closed the socket."""


class Client:
    """A client socket, one message at a time.

    Args:
        site: site of the worker.
        path: path of the socket.
        protocol: offered subprotocol.
        shake: mutation of the handshake.
    """

    def __init__(self, site: Site, path: str, *, protocol: str = "", shake: Any = None) -> None:
        key = base64.b64encode(b"0123456789abcdef").decode()
        lines = [f"GET {path} HTTP/1.1", "Host: 127.0.0.1", "Upgrade: websocket"]
        lines += ["Connection: Upgrade", f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13"]
        lines += [f"Sec-WebSocket-Protocol: {protocol}"] if protocol else []
        request = "\r\n".join([*lines, "", ""]).encode()
        self._bytes = b""
        self.connection = site.connected()
        self.connection.sendall(shake(request) if shake else request)
        self.connection.settimeout(QUIET_S if shake else DEAD_S)
        try:
            while b"\r\n\r\n" not in self._bytes:
                self._receive()
        except TimeoutError:
            self.close()
            raise
        head, _, self._bytes = self._bytes.partition(b"\r\n\r\n")
        self.status = int(head.split(b" ", 2)[1])
        assert self.status < 500, head
        if self.status != 101:
            self.close()
            raise Left(f"{self.status}")
        self.connection.settimeout(DEAD_S)

    def send(self, data: bytes) -> None:
        """Send raw bytes."""
        with contextlib.suppress(ConnectionError):
            self.connection.sendall(data)

    def message(self) -> tuple[int, bytes]:
        """Opcode and content of the next message. Raises Left with the code and the reason."""
        while True:
            while (found := self._frame()) is None:
                self._receive()
            kind, data = found
            if kind == CLOSE:
                code = int.from_bytes(data[:2], "big")
                self.close()
                raise Left(f"{code} {mutation.shape_of(data[2:].decode())}")
            if kind in (TEXT, BINARY):
                return kind, data

    def close(self, *, hard: bool = False) -> None:
        """Disconnect without a close frame. ``hard``: with a reset."""
        if hard and self.connection.fileno() >= 0:
            linger = struct.pack("ii", 1, 0)
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        self.connection.close()

    def _receive(self) -> None:
        try:
            part = self.connection.recv(1 << 16)
        except ConnectionError as error:
            raise Left("reset") from error
        if not part:
            self.close()
            raise Left("closed")
        self._bytes += part

    def _frame(self) -> tuple[int, bytes] | None:
        data = self._bytes
        if len(data) < 2:
            return None
        start, size = 2, data[1] & 0x7F
        if size == 126:
            start, size = 4, int.from_bytes(data[2:4], "big")
        elif size == 127:
            start, size = 10, int.from_bytes(data[2:10], "big")
        if len(data) < start + size:
            return None
        self._bytes = data[start + size :]
        return data[0] & 0x0F, data[start : start + size]


# --- the drive socket -------------------------------------------------------------------------


class Drive:
    """A controller that sends mutated messages on one socket until it is closed."""

    KINDS = ("hello", "reset", "action", "edit", "render", "agent", "snapshot", "restore")
    LAST = ("fork", "bye")

    def __init__(self, site: Site) -> None:
        self._site = site
        self._client: Client | None = None
        self._step = 0
        self._now = 0

    def attack(self, rng: random.Random) -> str:
        """Send one damaged message or hello. Returns the outcome."""
        if self._client is None or rng.random() < 0.05:
            damaged = rng.random() < 0.5
            try:
                said = self._join(rng, damaged=damaged)
            except Left as left:
                self._client = None
                return f"hello: {left}"
            if damaged:
                return f"hello: {said}"
        kind, data = self._message(rng)
        try:
            return self._say(kind, data, rng)
        except Left as left:
            self._client = None
            return str(left)

    def _join(self, rng: random.Random, *, damaged: bool) -> str:
        if self._client is not None:
            self._client.close(hard=rng.random() < 0.3)
            self._site.settle()
        self._site.restore()
        self._client = Client(self._site, self._path(), protocol=DRIVE_SUBPROTOCOL)
        hello = encode(self._hello())
        kind = BINARY
        if damaged:
            kind, hello = _damaged(hello, rng)
        self._client.send(frame(kind, hello))
        said = self._answer()
        if not damaged:
            assert said.endswith("welcome") or "CONTROLLER" in said, said
        return said

    def _path(self) -> str:
        return f"/v1/sessions/{self._site.known['session_id']}/drive"

    def _hello(self) -> dict[str, Any]:
        return {
            "v": 1, "type": "hello", "id": 1, "protocols": [DRIVE_SUBPROTOCOL],
            "token": self._site.known["token"], "role": "controller", "sdk": "fuzz",
        }  # fmt: skip

    def _message(self, rng: random.Random) -> tuple[int, bytes]:
        reset, action = self.KINDS[1:3]
        if rng.random() < 0.25:  # A valid message, so that the next damage reaches deeper.
            return BINARY, encode(self._right(reset if rng.random() < 0.3 else action, rng))
        kind = rng.choice((*self.KINDS, *self.KINDS, *self.KINDS, *self.LAST))
        return _damaged(encode(self._right(kind, rng)), rng)

    def _right(self, kind: str, rng: random.Random) -> dict[str, Any]:
        times = [self._now + 100_000 * (k + 1) for k in range(3)]
        poses = [(k + 1.0, 0.0, 0.0) for k in range(3)]
        plans = (
            {"kind": "trajectory", "times_us": times, "poses": poses},
            {"kind": "control", "acceleration": 1.0, "steering": 0.1},
            {"kind": "pose", "x": 1.0, "y": 0.0, "yaw": 0.0},
        )  # fmt: skip
        spec = {
            "seed": 3, "dt_us": 100_000, "horizon": 8, "sensors": [SENSOR], "privileged": True,
            "action": rng.choice(("trajectory", "control", "pose")), "deadline_ms": 2000,
            "ego": {"tracker": rng.choice(("pursuit", "lqr", "perfect")), "wheelbase": 2.8},
            "agents": {"default": "log", "drivers": {"car_blue": {"kind": rng.choice(
                ("idm", "external", "cut_in", "hard_brake", "constant_velocity"))}}},
            "contact": {"masses": {"post": 20.0}}, "on_collision": "continue",
        }  # fmt: skip
        move = {"op": "translate", "object_id": "post", "x": 0.5, "y": 0.0}
        content: dict[str, Any] = {
            "hello": {"protocols": [DRIVE_SUBPROTOCOL], "role": "observer"},
            "reset": {"spec": spec},
            "action": {"step": self._step, "plan": rng.choice(plans)},
            "edit": {"operations": [move, {"op": "delete", "object_id": "car_red"}]},
            "render": {"sensors": [SENSOR | {"modalities": ["rgb", "depth"], "codec": "png"}]},
            "agent": {"object_id": "car_blue", "times_us": times, "poses": poses},
            "snapshot": {"name": "here"},
            "restore": {"name": "here"},
        }
        return {"v": 1, "type": kind, "id": rng.randrange(99), **content.get(kind, {})}

    def _say(self, kind: int, data: bytes, rng: random.Random) -> str:
        client = self._client
        assert client is not None
        way = rng.random()
        if way < 0.03:  # Disconnect while the answer is computed.
            client.send(frame(kind, data))
            client.close(hard=way < 0.015)
            raise Left("left")
        if way < 0.1 and len(data) > 2:
            cut = rng.randrange(1, len(data))
            client.send(frame(kind, data[:cut], last=False) + frame(PING, b"x"))
            client.send(frame(0, data[cut:]))
        else:
            client.send(frame(kind, data))
        return self._answer()

    def _answer(self) -> str:
        assert self._client is not None
        while True:
            kind, data = self._client.message()
            assert kind == BINARY, data[:500]
            said = decode(data)
            if said["type"] == "obs":
                self._step, self._now = said["step"], said["t_us"]
            if said["type"] == "error":
                assert said["code"] not in ("INTERNAL", "OUT_OF_MEMORY"), said
                return f"{said['code']} {mutation.shape_of(said['detail'])}"
            if said["type"] != "progress":
                return str(said["type"])


def _damaged(data: bytes, rng: random.Random) -> tuple[int, bytes]:
    kind = rng.random()
    if kind < 0.6:
        data = mutation.damaged_msgpack(data, rng)
    elif kind < 0.85:
        data = mutation.damaged_bytes(data, list(ODD_BYTES), rng)
    elif kind < 0.95:
        data = rng.choice(ODD_BYTES)
    else:
        return TEXT, rng.choice(ODD_TEXTS).encode("utf-8", "surrogatepass")
    return BINARY, data[:LIMIT]


# --- the view socket --------------------------------------------------------------------------


class View:
    """A browser that sends mutated requests on one socket until it is closed."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._client: Client | None = None

    def attack(self, rng: random.Random) -> str:
        """Send one damaged request or hello. Returns the outcome."""
        hello = json.dumps({"type": "hello", "token": TOKEN}).encode()
        try:
            if self._client is None or rng.random() < 0.05:
                damaged = rng.random() < 0.5
                if self._client is not None:
                    self._client.close(hard=rng.random() < 0.3)
                self._site.restore()
                path = f"/v1/scenarios/{self._site.known['scenario_id']}/view"
                self._client = Client(self._site, path)
                kind, hello = self._damaged(hello, rng) if damaged else (TEXT, hello)
                self._client.send(frame(kind, hello))
                said = self._answer()
                if damaged:
                    return f"hello: {said}"
                assert said == "welcome", said
            kind, data = self._damaged(self._question(rng), rng)
            self._client.send(frame(kind, data))
            if rng.random() < 0.03:
                self._client.close(hard=rng.random() < 0.5)
                raise Left("left")
            return self._answer()
        except Left as left:
            self._client = None
            return str(left)

    def _question(self, rng: random.Random) -> bytes:
        asked: dict[str, Any] = {"seq": 3, "camera": "front", "t_us": 500_000, "width": 32}
        kind = rng.random()
        if kind < 0.3:
            asked["T_world_camera"] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1.5, 0, 0, 0, 1]
        elif kind < 0.5:
            asked["pick"] = [0.5, 0.5]
        elif kind < 0.7:
            move = {"op": "translate", "object_id": "post", "x": 0.5, "y": 0.0}
            asked["operations"] = [move, {"op": "recolour", "object_id": "post", "hue": 0.2}]
        elif kind < 0.8:
            asked["job"] = self._site.known["job_id"]
        return json.dumps(asked).encode()

    def _damaged(self, data: bytes, rng: random.Random) -> tuple[int, bytes]:
        kind = rng.random()
        if kind < 0.6:
            return TEXT, mutation.damaged_json(data, rng)
        if kind < 0.85:
            text = mutation.damaged_bytes(data, [], rng).decode("utf-8", "replace")
            return TEXT, text.encode()[:LIMIT]
        if kind < 0.95:
            return TEXT, rng.choice(ODD_TEXTS).encode("utf-8", "surrogatepass")
        return BINARY, rng.choice(ODD_BYTES)

    def _answer(self) -> str:
        assert self._client is not None
        while True:
            kind, data = self._client.message()
            if kind == BINARY:
                return "frame"
            said = json.loads(data)
            if said["type"] == "error":
                assert said["code"] not in ("INTERNAL", "OUT_OF_MEMORY"), said
                return f"{said['code']} {mutation.shape_of(said['detail'])}"
            if said["type"] != "changed":
                return str(said["type"])


# --- invalid frames -----------------------------------------------------------------------------


def odd_frames(site: Site, rng: random.Random) -> str:
    """Send a handshake or frames with damaged bytes. Returns the outcome."""
    is_view = rng.random() < 0.5
    kind = "scenarios" if is_view else "sessions"
    known = site.known["scenario_id" if is_view else "session_id"]
    path = f"/v1/{kind}/{known}/{'view' if is_view else 'drive'}"
    protocol = "" if is_view else DRIVE_SUBPROTOCOL
    shake = (lambda data: mutation.damaged_bytes(data, [], rng)) if rng.random() < 0.3 else None
    client = None
    try:
        client = Client(site, path, protocol=protocol, shake=shake)
        client.connection.settimeout(QUIET_S)
        client.send(_odd_bytes(site, is_view, rng))
        ended = time.monotonic() + DEAD_S
        while time.monotonic() < ended:
            client.message()
        raise AssertionError("it goes on talking")
    except Left as left:
        return str(left)
    except TimeoutError:
        return "silence"
    finally:
        if client is not None:
            client.close(hard=rng.random() < 0.3)


def _odd_bytes(site: Site, is_view: bool, rng: random.Random) -> bytes:
    if is_view:
        hello = frame(TEXT, json.dumps({"type": "hello", "token": TOKEN}).encode())
        more = frame(TEXT, b'{"camera": "front", "t_us": 0, "width": 16}')
    else:
        said = {"v": 1, "type": "hello", "protocols": [DRIVE_SUBPROTOCOL], "role": "observer"}
        hello = frame(BINARY, encode(said | {"token": site.known["token"]}))
        more = frame(BINARY, encode({"v": 1, "type": "render", "sensors": [SENSOR]}))
    odd = (
        frame(TEXT, b"\xff\xfe"), frame(TEXT, b"\xed\xa0\x80"), frame(0, b"x"), frame(3, b""),
        frame(BINARY, b"x", last=False) * 2, frame(PING, b"x" * 126), frame(CLOSE, b"\x03"),
        frame(CLOSE, b"\x00\x00"), frame(CLOSE, b"\x03\xe8\xff"), frame(PING, b"x", last=False),
        frame(BINARY, b"x", flags=0x40), frame(BINARY, b"x", flags=0x70), frame(PONG, b"y"),
        b"\x82\xff" + b"\x7f" + b"\xff" * 7, b"\x82\xff" + b"\xff" * 8, b"\x82\x05hello",
        b"\x82\xff" + (LIMIT + 1).to_bytes(8, "big") + b"\x00" * 4, frame(CLOSE, b"\x03\xe8bye"),
        frame(TEXT, b"\xf0\x9f", last=False) + frame(0, b"\x98\x80"), b"GET / HTTP/1.1\r\n\r\n",
        frame(BINARY, b"", last=False) * 500,
    )  # fmt: skip
    stream = b"".join(rng.choice((hello, more, *odd)) for _ in range(rng.choice((1, 2, 4))))
    stream = hello + stream if rng.random() < 0.7 else stream
    return mutation.damaged_bytes(stream, list(odd), rng) if rng.random() < 0.5 else stream
