"""Sensors of sessions: message size limits, and preparation of clouds."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence

from real2sim_proto import ErrorCode
from real2sim_proto.codec import MAX_SERVER_MESSAGE_BYTES
from real2sim_proto.drive import Render
from real2sim_proto.episode import SensorSpec
from real2sim_proto.sensors import LidarSpec, RadarSpec
from real2sim_proto.sessions import SessionRender

from ...edit import ScenarioState
from ...render.cast import CastBackend, prepare_rays, select_caster
from ...render.cast.call import kernels_of_casting_on_disk, warm_up_casting
from ...render.modalities import modality_of
from ...scene import Camera, Scene
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
from ..http.responses import ServiceError
from ..render_background import BackgroundCompile
from ..renderer import check_known, check_sensors

MAX_IMAGE_BYTES = MAX_SERVER_MESSAGE_BYTES - 1024 * 1024
"""Maximum size of raw images in one message [bytes]; the rest is for its other members."""


def cameras_of(scene: Scene, sensors: Sequence[SensorSpec], *, max_pixels: int) -> list[Camera]:
    """The cameras of sensors in order, at the requested sizes.

    Raises:
        ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels or bytes, and for
            images that the scene lacks.
    """
    cameras = check_sensors(scene.rig, sensors, max_pixels=max_pixels)
    check_known(scene, sensors)
    check_message_bytes(raw_image_bytes(sensors, cameras))
    return cameras


def check_message_bytes(size: int) -> None:
    """Raises ServiceError: INVALID_REQUEST if raw images and clouds exceed one message."""
    if size > MAX_IMAGE_BYTES:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"{size} bytes of raw images and clouds in one message; readers allow "
            f"{MAX_IMAGE_BYTES}",
            hint="ask for smaller or fewer images, or for codec 'jpeg' or 'png'",
        )


def raw_image_bytes(sensors: Sequence[SensorSpec], cameras: Iterable[Camera]) -> int:
    """Size of the raw images of one step [bytes]; ``cameras`` has one camera per sensor."""
    return sum(
        modality_of(modality).raw_bytes(camera.width, camera.height)
        for camera, sensor in zip(cameras, sensors, strict=True)
        for modality in sensor.modalities
        if sensor.codec == "raw"
    )


POINT_BYTES = 40
"""Upper bound for a point with all its columns, or a radar detection [bytes]."""


async def mount_sensors(
    lidars: Sequence[LidarSpec], radars: Sequence[RadarSpec], dt_us: int
) -> RangingSensors:
    """Like :func:`.mounted_sensors`; also prepares the rays, off the event loop and the engine.

    Raises:
        WorldError: INVALID_REQUEST.
    """
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


async def ranging_for_render(world: World, asked: SessionRender | Render) -> RangingSensors:
    """LiDARs and radars of a render request. Raises WorldError: INVALID_REQUEST."""
    return await mount_sensors(asked.lidars, asked.radars, world.spec.dt_us)


class WorldClouds:
    """Casts the rays of worlds.

    Args:
        engine: loads the kernels.
        max_rays: limit over all LiDARs and radars of one observation.
        caster: name of the ray casting backend, see :func:`.cast`.
    """

    def __init__(self, engine: Engine, *, max_rays: int, caster: str = "auto") -> None:
        self._max_rays = max_rays
        self._name = caster
        self._caster: CastBackend | None = None
        self._kernels = BackgroundCompile(
            engine,
            "LiDAR and radar",
            warm_up_casting,
            on_disk=kernels_of_casting_on_disk,
        )

    async def ready(self, sensors: RangingSensors, *, image_bytes: int = 0) -> None:
        """Wait until clouds of these sensors can be computed without delaying others.

        Args:
            sensors: sensors of an episode, or of a render request.
            image_bytes: size of raw images in the same message.

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
        """Clouds of the due sensors, in order."""
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
