"""Instants of worlds as messages: computed, drawn, encoded and packed off the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from real2sim_proto import ErrorCode
from real2sim_proto.codec import DEFAULT_MAX_BYTES
from real2sim_proto.drive import SensorSpec

from ...edit import ScenarioState, instances_at
from ...scene import Camera, Scene
from ...world import World
from ..http.metrics import Metrics
from ..http.problems import ServiceError
from ..rendering.engine import Engine
from ..rendering.renderer import Image, Renderer, RenderRequest, check_sensors
from .wire import (
    EncodedFrame,
    FrameHead,
    Members,
    Message,
    Stopwatch,
    encode_frame,
    pack_members,
    pack_with_frames,
    raw_bytes,
    raw_heads,
    with_pixels,
)

T = TypeVar("T")

Tell = Callable[[Message], object]

WARM_UP_WIDTH = 320
MAX_IMAGE_BYTES = DEFAULT_MAX_BYTES - 1024 * 1024
"""Of raw images in one message; the rest of it fits in what is left of a reader's limit."""


@dataclass(frozen=True, eq=False)
class RenderedObservation:
    """An instant on its way into a message.

    Attributes:
        world: at that instant.
        images: in the order of sensors and modalities.
        kind, members: of the message, without frames and timing.
        watch: runs on.
    """

    world: World
    images: Sequence[Image]
    kind: str
    members: Members
    watch: Stopwatch


@dataclass(frozen=True, eq=False)
class EncodedObservation:
    """An instant as a message.

    Attributes:
        world: at that instant; it has not taken effect by being shown.
        frames: the images of the message.
        message: for all who get it.
        timing_ms: by stage.
    """

    world: World
    frames: Sequence[EncodedFrame]
    message: Message
    timing_ms: Mapping[str, float]


class ObservationRenderer:
    """Makes messages of instants.

    A world without sensors moves on a thread of its own: it needs no device, and its planner
    should not wait while other sessions are drawn. All else is one job of the engine. While it
    draws, another thread settles whatever images do not show, and says in advance what raw images
    will be. Those are packed on the engine at once; others are encoded beside it.

    Args:
        engine: runs what is drawn.
        pictures: draws and encodes.
        metrics: gets durations by stage.
        max_pixels: over all images of one instant.
    """

    def __init__(
        self, engine: Engine, pictures: Renderer, metrics: Metrics, *, max_pixels: int
    ) -> None:
        self._engine = engine
        self._pictures = pictures
        self._metrics = metrics
        self._max_pixels = max_pixels
        self._worlds = ThreadPoolExecutor(1, thread_name_prefix="worlds")
        self._aside = ThreadPoolExecutor(1, thread_name_prefix="aside")

    def close(self) -> None:
        """End its threads."""
        self._worlds.shutdown(cancel_futures=True)
        self._aside.shutdown(cancel_futures=True)

    def cameras(self, scene: Scene, sensors: Sequence[SensorSpec]) -> dict[str, Camera]:
        """Cameras of ``sensors`` by name. Raises ServiceError: UNKNOWN_CAMERA, INVALID_REQUEST."""
        cameras = self._checked(scene, sensors)
        return {s.camera: c for s, c in zip(sensors, cameras, strict=True)}

    async def on_world_thread(self, fn: Callable[..., T], *args: Any) -> T:
        """``fn(*args)`` on the thread that moves worlds without sensors."""
        return await asyncio.get_running_loop().run_in_executor(self._worlds, fn, *args)

    async def observe(
        self,
        change: Callable[[], World],
        cameras: Mapping[str, Camera],
        *,
        settle: Callable[[World], object] = World.evaluate,
        tell: Tell | None = None,
    ) -> EncodedObservation:
        """The world that ``change`` makes, and the observation of it.

        Args:
            change: makes the new world, complete as far as images show it; runs on another thread
                and leaves the present one alone.
            cameras: of the world's sensors, by name, at the sizes asked for.
            settle: completes that world and puts it on record; runs beside the drawing, and has
                ended when this method returns or raises. Where it raises, nothing has happened.
            tell: called on the event loop with an observation of raw images as soon as it is there,
                before this method returns; nothing fails after it, and no request of a client that
                has been told is looked at before the caller goes on.

        Raises:
            QueueFullError: too much waits for the engine.
        """
        watch = Stopwatch()

        def work() -> RenderedObservation | EncodedObservation:
            watch.stage("queue")
            world = change()
            sensors = world.due_sensors()
            shot = [cameras[s.camera] for s in sensors]
            watch.stage("world")
            if sensors:
                settling = self._aside.submit(_settled, world, settle, sensors, shot)
                try:
                    images = self._deformed_and_drawn(world, sensors, shot, watch)
                finally:
                    settling.exception()  # waits
                members, heads = settling.result()
            else:
                images = ()
                watch.stage("render")
                members, heads = _settled(world, settle, sensors, shot)
            # Of settling only what did not happen beside the drawing.
            watch.stage("settle")
            drawn = RenderedObservation(world, images, "obs", members, watch)
            if heads is None:
                return drawn
            frames = [with_pixels(h, i.pixels) for h, i in zip(heads, images, strict=True)]
            return _packed(drawn, frames)

        def told(made: RenderedObservation | EncodedObservation) -> None:
            if tell is not None and isinstance(made, EncodedObservation):
                tell(made.message)

        if cameras:
            made = await self._engine.call(work, label="drive", first=told)
        else:
            made = await self.on_world_thread(work)
        return await self._finish(made)

    async def view(self, world: World, sensors: Sequence[SensorSpec]) -> EncodedObservation:
        """Images of a committed instant, from cameras of the vehicle; time does not move.

        Raises:
            ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels.
            QueueFullError: too much waits for the engine.
        """
        cameras = self._checked(world.scene, sensors)
        watch = Stopwatch()

        def work() -> RenderedObservation:
            watch.stage("queue")
            images = self._images(world, sensors, cameras)
            watch.stage("render")
            members = pack_members({"t_us": world.t_us, "revision": world.revision})
            return RenderedObservation(world, images, "view", members, watch)

        return await self._finish(await self._engine.call(work, label="view"))

    async def first_render(self, scene: Scene, state: ScenarioState) -> None:
        """Draw a scene from its first camera, to have everything compiled and in memory."""
        shot = RenderRequest(
            scene=scene,
            instances=instances_at(scene, state, scene.start_us),
            T_world_vehicle=scene.ego.transform(scene.start_us),
            t_us=scene.start_us,
            sensors=(SensorSpec(camera=scene.rig.names[0], width=WARM_UP_WIDTH),),
        )
        await self._pictures.take(shot, stream="warm-up")

    def _checked(self, scene: Scene, sensors: Sequence[SensorSpec]) -> list[Camera]:
        cameras = check_sensors(scene.rig, sensors, max_pixels=self._max_pixels)
        size = sum(
            raw_bytes(modality, camera.width, camera.height)
            for camera, sensor in zip(cameras, sensors, strict=True)
            for modality in sensor.modalities
            if sensor.codec == "raw"
        )
        if size > MAX_IMAGE_BYTES:
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"{size} bytes of raw images in one message; readers allow {MAX_IMAGE_BYTES}",
                hint="ask for smaller or fewer images, or for codec 'jpeg' or 'png'",
            )
        return cameras

    def _deformed_and_drawn(
        self,
        world: World,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        watch: Stopwatch,
    ) -> Sequence[Image]:
        if world.deformation is not None:
            world.deformation.solve()
            watch.stage("physics")
        images = self._images(world, sensors, cameras)
        watch.stage("render")
        return images

    def _images(
        self, world: World, sensors: Sequence[SensorSpec], cameras: Sequence[Camera]
    ) -> Sequence[Image]:
        shot = RenderRequest(
            scene=world.scene,
            instances=world.instances(),
            T_world_vehicle=world.T_world_vehicle,
            t_us=world.t_us,
            sensors=sensors,
        )
        images, _ = self._pictures.draw(shot, cameras)
        return images

    async def _finish(self, made: RenderedObservation | EncodedObservation) -> EncodedObservation:
        if isinstance(made, RenderedObservation):
            frames = await self._pictures.on_encoders(encode_frame, made.images)
            (made,) = await self._pictures.on_encoders(lambda d: _packed(d, frames), [made])
        # Once the answer is on its way.
        asyncio.get_running_loop().call_soon(self._count, made)
        return made

    def _count(self, shown: EncodedObservation) -> None:
        for stage, ms in shown.timing_ms.items():
            self._metrics.stages.labels(stage).observe(ms / 1e3)
        for frame in shown.frames:
            self._metrics.frames.labels("drive", frame.codec).inc()


def _settled(
    world: World,
    settle: Callable[[World], object],
    sensors: Sequence[SensorSpec],
    cameras: Sequence[Camera],
) -> tuple[Members, list[FrameHead] | None]:
    """What there is to tell of a world, apart from images, once it is settled; and heads of its
    images, where all of them are raw."""
    settle(world)
    members = pack_members(world.observe().obs_fields())
    if any(sensor.codec != "raw" for sensor in sensors):
        return members, None
    return members, raw_heads(sensors, cameras, world.T_world_vehicle, world.t_us)


def _packed(drawn: RenderedObservation, frames: Sequence[EncodedFrame]) -> EncodedObservation:
    watch = drawn.watch
    watch.stage("encode")
    message = pack_with_frames(drawn.kind, drawn.members, frames, watch)
    return EncodedObservation(drawn.world, frames, message, watch.timing_ms)
