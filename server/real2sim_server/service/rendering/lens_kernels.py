"""Kernels that only cameras with lenses need: compiled when the first of them comes."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import structlog

from real2sim_proto import ErrorCode

from ...render import Backend, RenderError
from ...render.lenses import kernels_of_lenses_on_disk, refuse_lenses, warm_up_lenses
from ...scene import Camera
from ..engine import Engine
from ..first_run import awaited, compile_beside
from ..http.problems import ServiceError

log = structlog.get_logger(__name__)

NICENESS = 10
"""Of the process that compiles: the worker draws for others meanwhile."""


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
            beside = compile_beside(
                "warm_up_lenses", "cpu", package="render.lenses", niceness=NICENESS
            )
            async with awaited(beside):
                pass
        await self._engine.call(warm_up_lenses, self._backend, label="warm-up")
