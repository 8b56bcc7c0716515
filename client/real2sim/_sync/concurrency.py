"""How the sync client waits. Its counterpart in ``_async`` is written by hand too."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from websockets.sync.client import ClientConnection as Socket
from websockets.sync.client import connect as connect_socket

from .._handles import Handle
from ..errors import NotFoundError

P = ParamSpec("P")
T = TypeVar("T")

__all__ = ["Lookup", "Socket", "connect_socket", "receive", "run_blocking", "sleep"]


class Lookup(Handle):
    """Collections as mappings: ``client.scenes["street"]``, ``len(client.scenes)``."""

    def __getitem__(self: Any, key: Any) -> Any:
        """What ``get`` gives for an id, or the item of ``list`` at a place."""
        return self.list()[key] if isinstance(key, int | slice) else self.get(key)

    def __contains__(self: Any, key: Any) -> bool:
        try:
            self.get(key)
        except NotFoundError:
            return False
        return True

    def __len__(self: Any) -> int:
        return len(self.list())


def sleep(seconds: float) -> None:
    """Wait."""
    time.sleep(seconds)


def receive(socket: Socket, timeout: float) -> bytes | str:
    """The next message of a socket. Raises TimeoutError where none comes in ``timeout`` seconds."""
    return socket.recv(timeout=timeout)


def run_blocking(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """The result of a function that blocks on files."""
    return function(*args, **kwargs)
