"""Levels of detail for small images: counted, and made before the engine needs them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from real2sim_proto.episode import SensorSpec

from ...render import (
    Backend,
    Instance,
    levels_bytes,
    levels_estimate,
    make_levels,
    uses_levels,
    without_levels,
)
from ...render.frame import UNCERTAINTY, shown_as_colour
from ...scene import Camera
from ..library.memory import IdleItem, MemoryBudget


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
