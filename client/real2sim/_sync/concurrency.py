"""How the sync client waits. Its counterpart in ``_async`` is written by hand too."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from websockets.sync.client import ClientConnection as Socket
from websockets.sync.client import connect as connect_socket

P = ParamSpec("P")
T = TypeVar("T")

__all__ = ["Socket", "connect_socket", "receive", "run_blocking", "sleep"]


def sleep(seconds: float) -> None:
    """Wait."""
    time.sleep(seconds)


def receive(socket: Socket, timeout: float) -> bytes | str:
    """The next message of a socket. Raises TimeoutError where none comes in ``timeout`` seconds."""
    return socket.recv(timeout=timeout)


def run_blocking(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """The result of a function that blocks on files."""
    return function(*args, **kwargs)
