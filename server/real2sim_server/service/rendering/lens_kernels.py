"""Kernels that only cameras with lenses need: compiled when the first of them comes."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Sequence

import structlog

from real2sim_proto import ErrorCode

from ...render import Backend, RenderError
from ...render.lenses import kernels_of_lenses_on_disk, refuse_lenses, warm_up_lenses
from ...scene import Camera
from ..engine import Engine
from ..http.problems import ServiceError

log = structlog.get_logger(__name__)

POLL_S = 0.1
_PROGRAM = """
import os
os.nice(10)
from real2sim_server.render.lenses import warm_up_lenses
warm_up_lenses("cpu")
"""


class LensKernels:
    """Gets them ready beside the engine, which draws for all sessions meanwhile.

    A process of its own compiles them on the first run; the engine then loads what that left on
    disk. Belongs to the event loop.
    """

    def __init__(self, engine: Engine, backend: Backend) -> None:
        self._engine, self._backend = engine, backend
        self._made: asyncio.Task[None] | None = None

    async def ready(self, cameras: Sequence[Camera]) -> None:
        """Return once cameras can be drawn, some of which have lenses or rolling shutters.

        Raises:
            ServiceError: INVALID_REQUEST where the backend cannot draw them.
        """
        try:
            refuse_lenses(self._backend, cameras)
        except RenderError as error:
            raise ServiceError(ErrorCode.INVALID_REQUEST, str(error)) from error
        if self._made is None or (self._made.done() and self._made.exception() is not None):
            self._made = asyncio.create_task(self._make())
        # Whoever gives up waiting does not end it for others.
        await asyncio.shield(self._made)

    async def _make(self) -> None:
        if self._backend.name == "cpu" and not kernels_of_lenses_on_disk():
            log.info("compiling kernels of lenses, on the first run only")
            await _finished(
                subprocess.Popen(
                    [sys.executable, "-c", _PROGRAM],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        await self._engine.call(warm_up_lenses, self._backend, label="warm-up")


async def _finished(process: subprocess.Popen[bytes]) -> None:
    """Wait for a process, which does not outlive who waits."""
    try:
        while process.poll() is None:
            await asyncio.sleep(POLL_S)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
