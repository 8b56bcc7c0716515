"""Waiting in the async client. The counterpart in ``_sync`` is also written by hand."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from websockets.asyncio.client import ClientConnection as AsyncSocket
from websockets.asyncio.client import connect as connect_socket

from .._handles import Handle

P = ParamSpec("P")
T = TypeVar("T")

__all__ = ["AsyncSocket", "Lookup", "connect_socket", "receive", "run_blocking", "sleep"]


class Lookup(Handle):
    """Lookup methods of the sync client's collections, which an async client cannot offer."""

    def __getitem__(self, key: Any) -> Any:
        raise TypeError(f"{key!r} is fetched from the worker; write await ....get({key!r})")


async def sleep(seconds: float) -> None:
    """Wait for a number of seconds."""
    await asyncio.sleep(seconds)


async def receive(socket: AsyncSocket, timeout: float) -> bytes | str:
    """The next message of a socket. Raises TimeoutError if none arrives in ``timeout`` seconds."""
    async with asyncio.timeout(timeout):
        return await socket.recv()


async def run_blocking(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Run a function that blocks on files in a thread, and return its result."""
    return await asyncio.to_thread(function, *args, **kwargs)
