"""Clouds of worlds: what LiDARs and radars measure, on the engine's thread."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from real2sim_proto import ErrorCode
from real2sim_proto.ranging import LidarSpec, RadarSpec

from ...edit import ScenarioState
from ...render.cast import CastBackend, prepare_rays, select_caster
from ...render.cast.warm_up import kernels_of_casting_on_disk, warm_up_casting
from ...scene import Scene
from ...world import World
from ...world.ranging import (
    NO_SENSORS,
    Cloud,
    Mounted,
    MountedLidar,
    RangingSensors,
    mounted_sensors,
)
from ...world.sensing import clouds_of, recorded_cloud
from ..engine import Engine
from ..http.problems import ServiceError
from ..rendering.kernels_beside import KernelsBeside
from .image_limits import check_message_bytes

POINT_BYTES = 40
"""Of a point with all its columns, or a detection of a radar; with room."""


async def mounted_beside(
    lidars: Sequence[LidarSpec], radars: Sequence[RadarSpec], dt_us: int
) -> RangingSensors:
    """As :func:`.mounted_sensors`, and their rays prepared, beside event loop and engine. Raises
    WorldError: INVALID_REQUEST."""
    if not lidars and not radars:
        return NO_SENSORS

    def mounted() -> RangingSensors:
        sensors = mounted_sensors(lidars, radars, dt_us)
        for lidar in sensors.lidars:
            prepare_rays(lidar.lidar)
        for radar in sensors.radars:
            prepare_rays(radar.radar.rays)
        return sensors

    return await asyncio.to_thread(mounted)


class WorldClouds:
    """Casts the rays of worlds.

    Args:
        engine: loads the kernels.
        max_rays: over all LiDARs and radars of one observation.
        caster: name of the backend that casts, see :func:`.cast`.
    """

    def __init__(self, engine: Engine, *, max_rays: int, caster: str = "auto") -> None:
        self._max_rays = max_rays
        self._name = caster
        self._caster: CastBackend | None = None
        self._kernels = KernelsBeside(
            engine,
            "LiDAR and radar",
            warm_up_casting,
            on_disk=kernels_of_casting_on_disk,
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
        return clouds_of(world, due, self._chosen()) if due else []

    def recorded(
        self, scene: Scene, state: ScenarioState, mounted: MountedLidar, t_us: int
    ) -> Cloud:
        """A sweep from the recording vehicle. Raises TimeOutOfRangeError."""
        return recorded_cloud(scene, state, mounted, t_us, self._chosen())

    def _chosen(self) -> CastBackend:
        if self._caster is None:
            self._caster = select_caster(self._name)
        return self._caster


def _most_bytes(mounted: Mounted) -> int:
    return mounted.rays * mounted.most_returns * POINT_BYTES
