"""What the renderer prepares on other threads: rarely used kernels, and levels of detail."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import structlog

from real2sim_proto import ErrorCode
from real2sim_proto.episode import SensorSpec

from ..._numba import COMPILING
from ...render import (
    Backend,
    Instance,
    RenderError,
    levels_bytes,
    levels_estimate,
    make_levels,
    uses_levels,
    without_levels,
)
from ...render.frame import (
    UNCERTAINTY,
    kernels_of_lenses_on_disk,
    refuse_lenses,
    shown_as_colour,
    warm_up_lenses,
)
from ...scene import Camera
from ..engine import Engine
from ..first_run import awaited, compile_beside
from ..http.responses import ServiceError
from ..library.scenes import IdleItem, MemoryBudget

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


# --- Lenses --------------------------------------------------------------------------------------


class LensKernels:
    """Gets them ready beside the engine, see :class:`.KernelsBeside`."""

    def __init__(self, engine: Engine, backend: Backend) -> None:
        self._backend = backend
        self._kernels = KernelsBeside(
            engine,
            "lenses",
            warm_up_lenses,
            on_disk=kernels_of_lenses_on_disk,
            backend=backend,
        )

    async def ready(self, cameras: Sequence[Camera]) -> None:
        """Return once cameras can be drawn, some of which have lenses or rolling shutters.

        Raises:
            ServiceError: INVALID_REQUEST where the backend cannot draw them.
        """
        try:
            refuse_lenses(self._backend, cameras)
        except RenderError as error:
            raise ServiceError(ErrorCode.INVALID_REQUEST, str(error)) from error
        await self._kernels.ready()


# --- Levels of detail ----------------------------------------------------------------------------


class DetailLevels:
    """Makes the merged Gaussians that small images are drawn from, on a thread of its own.

    An image whose levels are missing would make them on the engine, and all sessions would wait.
    They leave memory with the clouds that they belong to.

    Args:
        backend: draws.
        budget: of memory, shared with scenes and assets; without it nothing is counted.
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
        """Memory of all levels that are there or being made."""
        return self._reserved + levels_bytes()

    def idle(self) -> list[IdleItem]:
        """Nothing: levels go with their scenes."""
        return []

    async def ready(
        self,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        things: Callable[[], Sequence[Instance]],
    ) -> None:
        """Wait until ``things`` have levels, where a camera needs them.

        Args:
            sensors: and their cameras, in the same order.
            cameras: at the sizes that the sensors name.
            things: gives what the cameras may see; called on the thread of the levels.

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
