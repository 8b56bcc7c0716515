"""Messages in parts arrive as one, in order, from any server."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.testclient import TestClient
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.exceptions import ConnectionClosedError, ConnectionClosedOK
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from real2sim_server.service.http.connections import ConnectionLimits, Connections
from real2sim_server.service.http.metrics import Metrics
from real2sim_server.service.http.websocket import (
    EXTENSION,
    ScatterGatherProtocol,
    let_take,
    send_parts,
)
from tests.waiting import LIMIT_S, wait_until

pytestmark = pytest.mark.network

Talk = Callable[[WebSocket], object]


def app(talk: Talk) -> Starlette:
    async def endpoint(websocket: WebSocket) -> None:
        await websocket.accept()
        await talk(websocket)

    return Starlette(routes=[WebSocketRoute("/", endpoint)])


@contextlib.contextmanager
def served(talk: Talk, *, deflate: bool = False) -> Iterator[str]:
    listener = socket.create_server(("127.0.0.1", 0))
    limits = ConnectionLimits(most=100, head_s=60, body_s=60, write_s=60)
    protocol = partial(ScatterGatherProtocol, Connections(limits, Metrics()))
    config = uvicorn.Config(
        app(talk), ws=protocol, ws_per_message_deflate=deflate, log_level="error"
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    try:
        yield f"ws://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(LIMIT_S)


def client(url: str, **options: object):
    return connect(url, max_size=None, proxy=None, **options)


def noise(size: int, seed: int = 0) -> bytes:
    return np.random.default_rng(seed).bytes(size)


def halves(data: bytes) -> list[bytes | memoryview]:
    middle = len(data) // 3
    return [data[:middle], memoryview(data)[middle:]]


# At 126 and 65536 bytes the length of a message takes more room in its header.
@pytest.mark.parametrize("size", [0, 1, 125, 126, 65535, 65536, 3_000_000])
def test_parts_arrive_as_one_message(size):
    data = noise(size)

    async def talk(websocket: WebSocket) -> None:
        await send_parts(websocket, halves(data))
        await websocket.receive_bytes()

    with served(talk) as url, client(url) as connection:
        assert connection.recv() == data
        connection.send(b"thanks")


def test_a_client_that_reads_late_gets_all_messages_in_order():
    messages = [noise(1_000_000, seed) for seed in range(24)]
    ways = []

    async def talk(websocket: WebSocket) -> None:
        write = websocket.scope["extensions"][EXTENSION]

        def noted(parts) -> bool:
            ways.append(write(parts))
            return ways[-1]

        websocket.scope["extensions"][EXTENSION] = noted
        for message in messages:
            await send_parts(websocket, halves(message))
        await websocket.receive_bytes()

    with served(talk) as url, client(url, max_queue=1) as connection:
        wait_until(lambda: False in ways, "the server to wait for the client")
        assert [connection.recv() for _ in messages] == messages
        connection.send(b"thanks")
    assert set(ways) == {True, False}


def test_the_client_of_a_closed_socket_is_told_to_be_gone():
    raised = threading.Event()

    async def talk(websocket: WebSocket) -> None:
        with pytest.raises(WebSocketDisconnect):
            await websocket.receive_bytes()
        try:
            await send_parts(websocket, [b"too", b"late"])
        except WebSocketDisconnect:
            raised.set()

    with served(talk) as url:
        with client(url):
            pass
        assert raised.wait(LIMIT_S)


def test_compressed_connections_get_their_messages_by_uvicorn():
    data = b"again and again" * 1000

    async def talk(websocket: WebSocket) -> None:
        assert EXTENSION not in websocket.scope["extensions"]
        await send_parts(websocket, halves(data))
        await websocket.receive_bytes()

    with served(talk, deflate=True) as url, client(url) as connection:
        assert connection.recv() == data
        connection.send(b"thanks")


def test_a_server_without_the_extension_sends_the_parts_joined():
    async def talk(websocket: WebSocket) -> None:
        await send_parts(websocket, halves(b"abcdef"))

    with TestClient(app(talk)).websocket_connect("/") as connection:
        assert connection.receive_bytes() == b"abcdef"


def frame(data: bytes, opcode: Opcode = Opcode.BINARY, *, fin: bool = True) -> bytes:
    return Frame(opcode, data, fin=fin).serialize(mask=True)


def taken(chunks: list[bytes]) -> tuple[list[bytes], list[bytes]]:
    """Messages in the order in which a server has them that is sent these bytes, a pause after
    each, and those of them that came by ``receive``."""
    messages: list[bytes] = []
    received: list[bytes] = []

    def take(data: bytes) -> bool:
        if data.startswith(b"later"):
            return False
        messages.append(data)
        return True

    async def talk(websocket: WebSocket) -> None:
        await websocket.receive_bytes()
        let_take(
            websocket, lambda data: not data.startswith(b"later") and not messages.append(data)
        )
        await send_parts(websocket, [b"begin"])
        while (data := await websocket.receive_bytes()) != b"later, the end":
            messages.append(data)
            received.append(data)
        await websocket.close()

    with served(talk) as url, client(url) as connection:
        connection.send(b"hello")
        connection.recv()
        for chunk in chunks:
            connection.socket.sendall(chunk)
            time.sleep(0.02)  # so that most arrive by themselves; what comes of them is the same
        connection.send(b"later, the end")
        with contextlib.suppress(ConnectionClosedOK):
            connection.recv(LIMIT_S)
    return messages, received


def test_messages_are_taken_however_their_bytes_arrive():
    one, two, large = frame(b"one"), frame(b"two"), frame(noise(70_000))
    cut = [two[:2], two[2:5], two[5:], one + two[:2], two[2:]]
    ping = frame(b"", Opcode.PING)
    parts = [frame(b"a", fin=False), ping, frame(b"b", Opcode.CONT)]
    chunks = [one, frame(noise(300)), *cut, one + two, ping + one, large, two, *parts, one]
    messages, _ = taken(chunks)
    texts = [b"one", noise(300), b"two", b"one", b"two", b"one", b"two", b"one", noise(70_000)]
    assert messages == [*texts, b"two", b"ab", b"one"]


def test_what_is_not_taken_is_received():
    assert taken([frame(b"one"), frame(b"later"), frame(b"two")]) == (
        [b"one", b"later", b"two"],
        [b"later"],
    )


def test_a_message_within_another_is_refused():
    chunks = [frame(b"a", fin=False), frame(b"one")]
    with pytest.raises(ConnectionClosedError, match="1002"):
        taken(chunks)


@pytest.mark.skipif(not hasattr(socket, "TCP_CONGESTION"), reason="Linux names them")
def test_what_goes_to_the_same_machine_is_not_paced():
    chosen = []

    async def talk(websocket: WebSocket) -> None:
        transport = websocket.scope["extensions"][EXTENSION].__self__.transport
        connection = transport.get_extra_info("socket")
        name = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16)
        chosen.append(name.rstrip(b"\0"))
        await send_parts(websocket, [b"done"])

    with served(talk) as url, client(url) as connection:
        connection.recv()
    assert chosen == [b"reno"]
