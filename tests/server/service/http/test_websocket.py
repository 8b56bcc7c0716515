"""Messages arrive complete and in order, even at a slow reader."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket
from websockets.sync.client import connect

from real2sim_server.service.http.connections import (
    Connection,
    ConnectionLimits,
    Connections,
    watch,
)
from real2sim_server.service.http.telemetry import Metrics
from tests.waiting import LIMIT_S

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
    config = uvicorn.Config(app(talk), ws_per_message_deflate=deflate, log_level="error")
    watch(config, Connections(limits, Metrics()))
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


@pytest.mark.parametrize("deflate", [True, False])
def test_a_slow_reader_receives_all_messages_in_order(deflate):
    messages = [np.random.default_rng(seed).bytes(1_000_000) for seed in range(24)]

    async def talk(websocket: WebSocket) -> None:
        for message in messages:
            await websocket.send_bytes(message)
        await websocket.receive_bytes()

    with served(talk, deflate=deflate) as url, client(url, max_queue=1) as connection:
        assert [connection.recv() for _ in messages] == messages
        connection.send(b"thanks")


@pytest.mark.skipif(not hasattr(socket, "TCP_CONGESTION"), reason="Linux names them")
def test_loopback_connections_are_not_paced(monkeypatch):
    chosen = []
    made = Connection.connection_made

    def noted(self, transport) -> None:
        made(self, transport)
        connection = transport.get_extra_info("socket")
        name = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16)
        chosen.append(name.rstrip(b"\0"))

    monkeypatch.setattr(Connection, "connection_made", noted)

    async def talk(websocket: WebSocket) -> None:
        await websocket.send_bytes(b"done")

    with served(talk) as url, client(url) as connection:
        connection.recv()
    assert chosen == [b"reno"]
