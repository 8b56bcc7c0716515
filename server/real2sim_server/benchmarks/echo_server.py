"""What sessions over sockets could reach at most: a server that answers each action by an
observation that was there before, by the worker's own server, protocol and event loop.

There is no world behind it, no log and no account, and no thread beside that of the event loop.
"""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from real2sim_proto import DRIVE_SUBPROTOCOL, encode
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES, unpack
from real2sim_proto.episode import ResetSpec
from real2sim_proto.sessions import SessionInfo

from ..service.preflight import bind, listen, url_of
from ..service.sessions.messages import action_in

Answer = Callable[[bytes], bytes]
"""The message that answers an action."""

HOST = "127.0.0.1"
START_S = 300.0
ECHOED = ("bytes", "messages")
"""Paths of such a server: it answers by bytes as they are, or reads and checks each action as a
worker does and packs each observation anew."""


@contextlib.contextmanager
def echo_servers(count: int, observation: bytes) -> Iterator[list[str]]:
    """Where so many servers listen, each in a process of its own.

    Args:
        count: of them.
        observation: that answers every action, with the id that it has, which is not 0.

    Raises:
        RuntimeError: one has not started.
    """
    spawning = multiprocessing.get_context("spawn")
    with contextlib.ExitStack() as running:
        ways = [spawning.Pipe(duplex=False) for _ in range(count)]
        for _, child in ways:
            process = spawning.Process(target=_serve, args=(child, observation), daemon=True)
            process.start()
            running.callback(process.join)
            running.callback(process.terminate)
        yield [_told(way) for way, _ in ways]


def echo_session(url: str) -> SessionInfo:
    """A session as a client of such a server knows it."""
    return SessionInfo(
        session_id="echo", scene="none", ws_url=url, token="", created_at="", reset=ResetSpec()
    )


def _told(way: Connection) -> str:
    if not way.poll(START_S):
        raise RuntimeError(f"a server of the bench has not started within {START_S:g} s")
    url: str = way.recv()
    return url


def _serve(told: Connection, observation: bytes) -> None:
    """A process of its own, until it is terminated."""
    listener = bind(HOST, 0)
    listen(listener)
    told.send(url_of(HOST, listener).replace("http", "ws", 1))
    config = uvicorn.Config(
        echo_app(observation),
        log_config=None,
        access_log=False,
        lifespan="off",
        ws="websockets-sansio",
        ws_per_message_deflate=False,
        ws_max_size=MAX_CLIENT_MESSAGE_BYTES,
    )
    uvicorn.Server(config).run(sockets=[listener])


def echo_app(observation: bytes) -> ASGIApp:
    """What such a server runs: a connection is answered by its path, which is one of ``ECHOED``."""
    fields = unpack(observation)

    def read_and_packed(action: bytes) -> bytes:
        action_in(action)
        return encode(fields)

    answers = dict(zip(ECHOED, (lambda _action: observation, read_and_packed), strict=True))

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        # A client that leaves is no error.
        with contextlib.suppress(WebSocketDisconnect):
            await _echo(WebSocket(scope, receive, send), answers[scope["path"].strip("/")])

    return app


async def _echo(socket: WebSocket, answer: Answer) -> None:
    """Hello, reset, and actions."""
    await socket.accept(subprotocol=DRIVE_SUBPROTOCOL)
    hello: dict[str, Any] = unpack(await socket.receive_bytes())
    welcome = {"v": 1, "type": "welcome", "id": hello["id"], "resume_token": ""}
    await socket.send_bytes(encode(welcome))
    while True:
        await socket.send_bytes(answer(await socket.receive_bytes()))
