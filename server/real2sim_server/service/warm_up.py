"""Prepares kernels ahead of use: compiled on the first run, later loaded from disk."""

from __future__ import annotations

import asyncio
import gc
import os
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

import structlog

from real2sim_proto.episode import ResetSpec

from .._numba import COMPILING, made
from ..console import StatusLine
from ..world import (
    deformation_on_disk,
    kernels_on_disk,
    may_deform,
    planning_on_disk,
    plans_ahead,
    warm_up_deformation,
    warm_up_planning,
)
from ..world import warm_up as warm_up_world
from .preflight import LOWEST_PRIORITY, Counter, awaited, compile_in_background, take_begun

TELL_EVERY_S = 0.5

log = structlog.get_logger(__name__)


class KernelWarmUp:
    """Prepares the kernels of one worker, starting with those that every session needs.

    On the first run, a second process compiles in parallel, and this process then loads the cached
    kernels from disk, see :mod:`.preflight`.
    """

    def __init__(self) -> None:
        self._beside: Counter | None = None
        self._compiled = False
        self._planning = asyncio.Event()
        self.deformation = DeformationKernels()

    async def run(self, warm_up_renderer: Callable[[], Awaitable[None]]) -> None:
        """Prepare the kernels that the worker needs before it accepts work."""
        telling = asyncio.create_task(self._tell())
        try:
            await self._run_first(warm_up_renderer)
        except BaseException:
            self._planning.set()
            raise
        finally:
            telling.cancel()

    def compiling(self) -> str | None:
        """Progress while kernels are compiled; None while they are loaded from disk."""
        beside = self._beside
        if beside is None:
            return f"{COMPILING}: {made}" if made.compiled and not self._compiled else None
        beside.read()
        done, expected = made.done + beside.done, made.expected + beside.expected
        return f"{COMPILING}: {done} of {max(done, expected)}"

    async def run_planning(self) -> None:
        """Prepare kernels that few sessions need, in the background; those sessions wait, see
        :meth:`ready`.

        If this fails, these sessions compile the kernels themselves.
        """
        try:
            if not planning_on_disk():
                beside = compile_in_background("warm_up_planning", niceness=LOWEST_PRIORITY)
                async with awaited(beside):
                    pass
            await asyncio.to_thread(warm_up_planning)
        finally:
            self._planning.set()

    async def ready(self, spec: ResetSpec) -> None:
        """Wait for the kernels that an episode requires."""
        if may_deform(spec):
            self.deformation.begin()
        if plans_ahead(spec.ego):
            await self._planning.wait()

    async def _run_first(self, warm_up_renderer: Callable[[], Awaitable[None]]) -> None:
        begun = take_begun()
        if begun is not None or (not kernels_on_disk() and (os.cpu_count() or 1) > 1):
            process = begun or compile_in_background("warm_up")
            self._beside = Counter(process)
            with _no_collections():
                async with awaited(process):
                    await warm_up_renderer()
            # These kernels are on disk if the other process has succeeded.
            self._beside, self._compiled = None, process.returncode == 0
        else:
            await warm_up_renderer()
        await asyncio.to_thread(warm_up_world)

    async def _tell(self) -> None:
        """Report progress: on one line of a terminal, else in the log at intervals."""
        line = StatusLine(log.info)
        try:
            while True:
                if (text := self.compiling()) is not None:
                    line.show(text)
                await asyncio.sleep(TELL_EVERY_S)
        finally:
            line.end()


class DeformationKernels:
    """Kernels for images after impacts, for use on the event loop.

    They take as long to compile as all others, and few sessions have an impact. The first episode
    that may have one starts their preparation in the background. Only images that need them wait.

    Attributes:
        ready: whether images after impacts can be rendered; read on any thread.
    """

    def __init__(self) -> None:
        self.ready = False
        self._making: asyncio.Task[None] | None = None

    def begin(self) -> None:
        """Prepare the kernels, unless they are ready or in progress."""
        if self._making is None:
            self._making = asyncio.create_task(self._make())

    async def wait(self) -> None:
        """Wait until they are ready or preparation fails; then they are compiled on demand."""
        self.begin()
        assert self._making is not None
        await asyncio.wait([self._making])

    async def close(self) -> None:
        """End the process that compiles them, if any."""
        if self._making is not None:
            self._making.cancel()
            await asyncio.wait([self._making])

    async def _make(self) -> None:
        try:
            if not await asyncio.to_thread(deformation_on_disk):
                log.info("compiling kernels of deformation, on the first run only")
                beside = compile_in_background("warm_up_deformation", niceness=LOWEST_PRIORITY)
                async with awaited(beside):
                    pass
            await asyncio.to_thread(warm_up_deformation)
        except Exception:
            log.exception("warm-up of deformation failed")
        finally:
            self.ready = True


@contextmanager
def _no_collections() -> Iterator[None]:
    """Disable garbage collection in the block: it takes a tenth of the compile time, for 100 MB."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
            gc.collect()
