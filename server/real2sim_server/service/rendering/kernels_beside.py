"""Kernels that not every worker needs: compiled beside the engine when somebody asks for them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial

import structlog

from ..._numba import COMPILING
from ...render import Backend
from ..engine import Engine
from ..first_run import awaited, compile_beside

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
        warm_up: compiles or loads them: a function at the top of its module.
        on_disk: whether an earlier run left them.
        backend: that ``warm_up`` takes, where it takes one; only that of CPUs compiles kernels.
    """

    def __init__(
        self,
        engine: Engine,
        what: str,
        warm_up: Callable[..., object],
        *,
        on_disk: Callable[[], bool],
        backend: Backend | None = None,
    ) -> None:
        self._engine, self._what, self._warm_up = engine, what, warm_up
        self._on_disk, self._arguments = on_disk, () if backend is None else (backend,)
        self._compiles = backend is None or backend.name == "cpu"
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
        if self._compiles and not await asyncio.to_thread(self._on_disk):
            log.info(COMPILING, of=self._what)
            beside = compile_beside(
                self._warm_up.__name__,
                *("cpu" for _ in self._arguments),
                package=self._warm_up.__module__.removeprefix("real2sim_server."),
                niceness=NICENESS,
            )
            async with awaited(beside):
                pass
        await self._engine.call(partial(self._warm_up, *self._arguments), label="warm-up")
