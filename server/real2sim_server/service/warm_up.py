"""Kernels are ready before the first request: compiled on the first run, later loaded from disk."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress

import structlog

from ..world import kernels_on_disk
from ..world import warm_up as warm_up_world

log = structlog.get_logger(__name__)

COMPILE_WORLD = "from real2sim_server.world import warm_up; warm_up()"
"""Program of the second process."""


def is_first_run() -> bool:
    """Whether kernels have to be compiled, which takes half a minute on two cores."""
    return not kernels_on_disk()


async def warm_up(warm_up_renderer: Callable[[], Awaitable[None]]) -> None:
    """Compile or load the kernels of renderer and world.

    Numba compiles one function at a time in a process. So on the first run a second process
    compiles the world's kernels beside the renderer's; this one then loads them from disk.
    """
    if is_first_run() and (os.cpu_count() or 1) > 1:
        log.info("compiling kernels, on the first run only")
        async with _world_compiled_beside():
            await warm_up_renderer()
    else:
        await warm_up_renderer()
    await asyncio.to_thread(warm_up_world)


@asynccontextmanager
async def _world_compiled_beside() -> AsyncIterator[None]:
    """A process compiles while the block runs; its failure is left to those who load its work."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", COMPILE_WORLD),
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
