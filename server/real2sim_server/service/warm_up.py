"""Kernels are ready before they are needed: compiled on the first run, later loaded from disk."""

from __future__ import annotations

import asyncio
import gc
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress

import structlog

from real2sim_proto.episode import EgoSpec

from ..world import kernels_on_disk, planning_on_disk, plans_ahead, warm_up_planning
from ..world import warm_up as warm_up_world

log = structlog.get_logger(__name__)

LOWEST_PRIORITY = 19


class KernelWarmUp:
    """Gets the kernels of one worker ready, those first that every session needs.

    Numba compiles one function at a time in a process. So on the first run a second process
    compiles beside this one, which then loads what the other left on disk.
    """

    def __init__(self) -> None:
        self._planning = asyncio.Event()

    async def run(self, warm_up_renderer: Callable[[], Awaitable[None]]) -> None:
        """What a worker needs before it takes work."""
        try:
            await self._run_first(warm_up_renderer)
        except BaseException:
            self._planning.set()
            raise

    async def run_planning(self) -> None:
        """What few sessions need, in the background: those that do wait for it, see :meth:`ready`.

        Where this fails, these sessions compile for themselves.
        """
        try:
            if not planning_on_disk():
                async with _compiled_beside("warm_up_planning", niceness=LOWEST_PRIORITY):
                    pass
            await asyncio.to_thread(warm_up_planning)
        finally:
            self._planning.set()

    async def ready(self, ego: EgoSpec) -> None:
        """Wait for the kernels that a vehicle needs."""
        if plans_ahead(ego):
            await self._planning.wait()

    async def _run_first(self, warm_up_renderer: Callable[[], Awaitable[None]]) -> None:
        if not kernels_on_disk() and (os.cpu_count() or 1) > 1:
            log.info("compiling kernels, on the first run only")
            with _no_collections():
                async with _compiled_beside("warm_up"):
                    await warm_up_renderer()
        else:
            await warm_up_renderer()
        await asyncio.to_thread(warm_up_world)


@asynccontextmanager
async def _compiled_beside(function: str, *, niceness: int = 0) -> AsyncIterator[None]:
    """A process runs a function of the world's warm-up while the block runs, and is waited for.
    Its failure is left to those who load its work."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", _PROGRAM, function, str(niceness)),
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        yield
        await process.wait()
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()


@contextmanager
def _no_collections() -> Iterator[None]:
    """No search for garbage in the block: it takes a tenth of the time of compiling, for 100 MB."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
            gc.collect()


_PROGRAM = """
import gc, os, sys
gc.disable()
os.nice(int(sys.argv[2]))
import real2sim_server.world
getattr(real2sim_server.world, sys.argv[1])()
"""
