"""Clouds of worlds: what LiDARs and radars measure, on the engine's thread."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from real2sim_proto import ErrorCode

from ...render.cast import CastBackend, select_caster
from ...render.cast.warm_up import kernels_of_casting_on_disk, warm_up_casting
from ...world import World
from ...world.ranging import Cloud, Mounted, RangingSensors
from ...world.sensing import clouds_of
from ..engine import Engine
from ..first_run import compile_beside
from ..http.problems import ServiceError
from ..rendering.kernels_beside import NICENESS, KernelsBeside
from .image_limits import check_message_bytes

POINT_BYTES = 40
"""Of a point with all its columns, or a detection of a radar; with room."""


class WorldClouds:
    """Casts the rays of worlds.

    Args:
        engine: loads the kernels.
        max_rays: over all LiDARs and radars of one observation.
    """

    def __init__(self, engine: Engine, *, max_rays: int) -> None:
        self._max_rays = max_rays
        self._caster: CastBackend | None = None
        self._kernels = KernelsBeside(
            engine,
            "LiDAR and radar",
            on_disk=kernels_of_casting_on_disk,
            compile=partial(
                compile_beside,
                "warm_up_casting",
                package="render.cast.warm_up",
                niceness=NICENESS,
            ),
            load=warm_up_casting,
        )

    async def ready(self, sensors: RangingSensors, *, image_bytes: int = 0) -> None:
        """Return once clouds of these sensors can be made without holding up others.

        Args:
            sensors: of an episode, or of a look aside.
            image_bytes: of raw images in the same message.

        Raises:
            ServiceError: INVALID_REQUEST for too many rays or bytes.
        """
        if not sensors:
            return
        rays = sum(mounted.rays for mounted in sensors.all)
        if rays > self._max_rays:
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"{rays:,} rays in one go; this worker allows {self._max_rays:,}",
                hint="ask for fewer LiDARs and radars, or for some with fewer rays",
            )
        check_message_bytes(image_bytes + sum(map(_most_bytes, sensors.all)))
        await self._kernels.ready()

    def of(self, world: World, due: Sequence[Mounted]) -> list[Cloud]:
        """Clouds of the sensors that are due, in their order."""
        if not due:
            return []
        if self._caster is None:
            self._caster = select_caster()
        return clouds_of(world, due, self._caster)


def _most_bytes(mounted: Mounted) -> int:
    return mounted.rays * mounted.most_returns * POINT_BYTES
