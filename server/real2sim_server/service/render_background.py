"""Background work of the renderer: compiles rarely used kernels, creates levels of detail."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import structlog

from real2sim_proto import ErrorCode
from real2sim_proto.episode import SensorSpec

from .._numba import COMPILING
from ..render import (
    Backend,
    Instance,
    RenderError,
    levels_bytes,
    levels_estimate,
    make_levels,
    uses_levels,
    without_levels,
)
from ..render.frame import (
    UNCERTAINTY,
    kernels_of_lenses_on_disk,
    refuse_lenses,
    shown_as_colour,
    warm_up_lenses,
)
from ..scene import Camera
from .engine import Engine
from .http.responses import ServiceError
from .library.scenes import IdleItem, MemoryBudget
from .preflight import awaited, compile_in_background

log = structlog.get_logger(__name__)

NICENESS = 10
"""Niceness of the compiling process; the worker keeps rendering during compilation."""


class BackgroundCompile:
    """Compiles kernels in another process while the engine keeps rendering.

    The engine then loads the compiled kernels from disk. Use on the event loop only.

    Args:
        engine: loads the kernels.
        what: purpose of the kernels, for the log.
        warm_up: module-level function that compiles or loads the kernels.
        on_disk: returns whether compiled kernels exist on disk.
        backend: argument of ``warm_up``, if it takes one. Only the CPU backend compiles.
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
        """Wait until the kernels are loaded."""
        if self._made is None or (self._made.done() and self._made.exception() is not None):
            self._made = asyncio.create_task(self._make())
        # A cancelled caller must not cancel the compilation for others.
        await asyncio.shield(self._made)

    def close(self) -> None:
        """End the compiling process, if any."""
        if self._made is not None:
            self._made.cancel()

    async def _make(self) -> None:
        if self._compiles and not await asyncio.to_thread(self._on_disk):
            log.info(COMPILING, of=self._what)
            beside = compile_in_background(
                self._warm_up.__name__,
                *("cpu" for _ in self._arguments),
                package=self._warm_up.__module__.removeprefix("real2sim_server."),
                niceness=NICENESS,
            )
            async with awaited(beside):
                pass
        await self._engine.call(partial(self._warm_up, *self._arguments), label="warm-up")


# --- Lenses --------------------------------------------------------------------------------------


class LensKernels:
    """Compiles the kernels of lenses in the background, see :class:`.BackgroundCompile`."""

    def __init__(self, engine: Engine, backend: Backend) -> None:
        self._backend = backend
        self._kernels = BackgroundCompile(
            engine,
            "lenses",
            warm_up_lenses,
            on_disk=kernels_of_lenses_on_disk,
            backend=backend,
        )

    async def ready(self, cameras: Sequence[Camera]) -> None:
        """Wait until cameras with lenses or rolling shutters can be rendered.

        Raises:
            ServiceError: INVALID_REQUEST if the backend does not support them.
        """
        try:
            refuse_lenses(self._backend, cameras)
        except RenderError as error:
            raise ServiceError(ErrorCode.INVALID_REQUEST, str(error)) from error
        await self._kernels.ready()


# --- Levels of detail ----------------------------------------------------------------------------


class DetailLevels:
    """Creates levels of detail (merged Gaussians for small images) on a background thread.

    Otherwise the engine would create them at the first image, and all sessions would wait. Levels
    are freed with their clouds.

    Args:
        backend: rendering backend.
        budget: memory budget shared with scenes and assets; None for no limit.
    """

    def __init__(self, backend: Backend, budget: MemoryBudget | None = None) -> None:
        self._backend = backend
        self._budget = budget
        self._reserved = 0
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="levels")
        if budget is not None:
            budget.add(self)

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown(cancel_futures=True)

    @property
    def held_bytes(self) -> int:
        """Memory of all levels, including unfinished ones [bytes]."""
        return self._reserved + levels_bytes()

    def idle(self) -> list[IdleItem]:
        """Always empty: levels are freed with their scenes."""
        return []

    async def ready(
        self,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        things: Callable[[], Sequence[Instance]],
    ) -> None:
        """Wait until ``things`` have the levels that the cameras need.

        Args:
            sensors: one per camera, in the same order.
            cameras: cameras at the sensors' image sizes.
            things: returns the instances that may be visible; called on the background thread.

        Raises:
            ServiceError: OUT_OF_MEMORY.
        """
        small = [
            sensor
            for sensor, camera in zip(sensors, cameras, strict=True)
            if uses_levels(self._backend, camera.width, camera.height, sensor.detail)
        ]
        if small:
            uncertain = any(UNCERTAINTY in sensor.modalities for sensor in small)
            make = partial(self._make, things, uncertain=uncertain)
            await asyncio.get_running_loop().run_in_executor(self._thread, make)

    def _make(self, things: Callable[[], Sequence[Instance]], *, uncertain: bool) -> None:
        shown = list(things())
        missing = without_levels(shown)
        if uncertain:
            missing += without_levels(map(shown_as_colour, shown))
        if not missing:
            return
        if self._budget is not None:
            needed = levels_estimate(missing)
            self._budget.make_room(
                "what small images are drawn from (detail: 'auto')",
                needed,
                reserve=lambda: self._reserve(needed),
            )
        try:
            make_levels(missing)
        finally:
            self._reserve(0)

    def _reserve(self, nbytes: int) -> None:
        self._reserved = nbytes
