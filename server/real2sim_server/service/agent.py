"""How much new work a worker takes, in the words that HAProxy's ``agent-check`` asks for.

Whether the worker lives is for ``/livez`` to say: a worker that drains is well, keeps its sessions,
and gets no new ones. The weight does not follow the load, since that would move scenes from worker
to worker; the proxy's bounded hashing sees to the load by itself.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass

import structlog

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Willingness:
    """What a worker takes.

    Attributes:
        ready: whether new work is welcome at all.
        full: whether as many sessions are open as may be.
        handed_over: whether its sessions are others' by now: nothing may be sent here any more.
    """

    ready: bool
    full: bool
    handed_over: bool


class Agent:
    """Answers every connection with one line, and closes it.

    Args:
        willingness: of the worker, asked for each answer.
        weight: of the worker among others, in per cent of what its proxy gives it.
    """

    def __init__(self, willingness: Callable[[], Willingness], *, weight: int) -> None:
        self._willingness = willingness
        self._weight = weight

    def word(self) -> str:
        """The line: ``up ready 100%``, ``drain``, or ``down``."""
        found = self._willingness()
        if found.handed_over:
            return "down"
        if not found.ready or found.full:
            return "up drain"
        return f"up ready {self._weight}%"

    @contextlib.asynccontextmanager
    async def running(self, host: str, port: int) -> AsyncIterator[int]:
        """Listens for the length of the block.

        Args:
            host: address to listen on.
            port: 0 takes a free one.

        Yields:
            The port.

        Raises:
            OSError: the address is taken, or none of this machine.
        """
        server = await asyncio.start_server(self._answer, host, port)
        try:
            yield server.sockets[0].getsockname()[1]
        finally:
            server.close()
            await server.wait_closed()

    async def _answer(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            writer.write(f"{self.word()}\n".encode())
            await writer.drain()
            writer.close()
            await writer.wait_closed()
