"""Kernels that not every worker needs: compiled beside the engine when somebody asks for them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from subprocess import Popen

import structlog

from ..engine import Engine
from ..first_run import awaited

log = structlog.get_logger(__name__)

NICENESS = 10
"""Of the process that compiles: the worker draws for others meanwhile."""


class KernelsBeside:
    """Gets kernels ready while the engine draws for all sessions.

    A process of its own compiles them on the first run; the engine then loads what that left on
    disk. Belongs to the event loop.

    Args:
        engine: loads them.
        what: they are for, for the log.
        on_disk: whether an earlier run left them, or none are compiled for this device.
        compile: starts a process of its own that compiles them.
        load: loads them, on the engine.
    """

    def __init__(
        self,
        engine: Engine,
        what: str,
        *,
        on_disk: Callable[[], bool],
        compile: Callable[[], Popen[bytes]],
        load: Callable[[], object],
    ) -> None:
        self._engine, self._what = engine, what
        self._on_disk, self._compile, self._load = on_disk, compile, load
        self._made: asyncio.Task[None] | None = None

    async def ready(self) -> None:
        """Return once they are there."""
        if self._made is None or (self._made.done() and self._made.exception() is not None):
            self._made = asyncio.create_task(self._make())
        # Whoever gives up waiting does not end it for others.
        await asyncio.shield(self._made)

    def close(self) -> None:
        """End the process that compiles them, if there is one."""
        if self._made is not None:
            self._made.cancel()

    async def _make(self) -> None:
        if not await asyncio.to_thread(self._on_disk):
            log.info("compiling kernels, on the first run only", of=self._what)
            async with awaited(self._compile()):
                pass
        await self._engine.call(self._load, label="warm-up")
