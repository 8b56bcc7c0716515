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
from websockets.sync.client import connect

from real2sim_server.service.http.connections import ConnectionLimits, Connections
from real2sim_server.service.http.metrics import Metrics
from real2sim_server.service.http.websocket import EXTENSION, ScatterGatherProtocol, send_parts

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
        thread.join(30)


def client(url: str, **options: object):
    return connect(url, max_size=None, proxy=None, close_timeout=2, **options)


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
        give_up = time.monotonic() + 30
        while False not in ways and time.monotonic() < give_up:
            time.sleep(0.01)
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
        assert raised.wait(10)


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
