"""The step pipeline: from the bytes of an action to the bytes of the observation that answers it.

A step passes seven phases. Each is a function of that name, so that a profile shows them too.

============  =====================  ==========================================================
phase         runs on                what happens
============  =====================  ==========================================================
``receive``   event loop             a message is read, decoded and validated (`connection`)
``check``     event loop             role, session, lock step: is this the action due (`connection`)
``advance``   engine                 a fork of the world moves, as far as images show it
``render``    engine                 deformations, then the images of all sensors due
``evaluate``  beside the rendering   metrics and events; the log entry is written; all of the
                                     observation but its images is packed, headers of raw images
                                     included
``encode``    engine, or encoders    raw images are taken as they are on the engine, or copied into
                                     the memory that the client reads them from; others are
                                     encoded beside it; the parts become one message
``send``      event loop             written to the socket in the very call that ends the engine's
                                     job; what cannot be written at once goes the ordinary way
============  =====================  ==========================================================

A world without sensors moves on a thread of its own: it needs no device, and its planner should not
wait while other sessions are rendered. Steps that wait for that thread are made in one go, phase by
phase: their log entries are one transaction, and they wake the event loop once. The action that is
due there is received and checked in the call that reads it from the socket, and no task is woken
for its observation (`steps_at_once`); all else goes as above.

Where the backend draws images of several worlds in one go (the serving kernels all, the CPU's small
ones), steps of sessions on one scene that wait for the engine together pass the phases together, as
far as TOGETHER_PIXELS: their images are those that each would get alone, bit for bit. None waits
for another that is not there yet, and one that came first is left behind once at most.

The phases are in `phases`, those of several steps together in `blind_steps` and `joint_drawing`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from real2sim_proto.episode import SensorSpec

from ...edit import ScenarioState, compose, instances_at, things_at_start
from ...render import Instance
from ...scene import Camera, Scene
from ...world import World
from ...world.ranging import NO_SENSORS, Cloud, MountedLidar, RangingSensors
from ..engine import Engine
from ..http.metrics import Metrics
from ..lanes import Lane
from ..rendering.renderer import Renderer, RenderRequest
from ..warm_up import DeformationKernels
from .blind_steps import BlindSteps
from .gathered_calls import GatheredCalls
from .image_limits import cameras_of, raw_image_bytes
from .joint_drawing import JointDrawing, share_of
from .observation import EncodedObservation, RenderedObservation, with_frames
from .phases import KernelsMissingError, StepPhases
from .segment import FrameSlot
from .transition import Transition
from .wire import PhaseTimer, pack_members
from .world_clouds import WorldClouds
from .world_images import Images, WorldImages

T = TypeVar("T")

WARM_UP_WIDTH = 320


class StepPipeline:
    """Makes observations of changed worlds, and views of present ones.

    Args:
        engine: runs what is rendered.
        renderer: renders and encodes.
        metrics: gets durations by stage.
        deformation: kernels that images after impacts need.
        max_pixels: over all images of one instant.
        max_rays: over all LiDARs and radars of one instant.
        caster: name of the backend that casts their rays, see :func:`.cast`.
    """

    def __init__(
        self,
        engine: Engine,
        renderer: Renderer,
        metrics: Metrics,
        *,
        deformation: DeformationKernels,
        max_pixels: int,
        max_rays: int,
        caster: str = "auto",
    ) -> None:
        self._engine = engine
        self._renderer = renderer
        self._metrics = metrics
        self._max_pixels = max_pixels
        self._images = WorldImages(renderer)
        self._clouds = WorldClouds(engine, max_rays=max_rays, caster=caster)
        self._phases = StepPhases(self._images, self._clouds, deformation)
        self._joint = JointDrawing(self._phases, self._images)
        self._blind = BlindSteps(self._phases)
        self._worlds = ThreadPoolExecutor(1, thread_name_prefix="worlds")
        self._steps: GatheredCalls[Transition, EncodedObservation] = GatheredCalls(
            self._blind.compute, self._worlds, on_result=self.send
        )

    def close(self) -> None:
        """End its threads."""
        self._worlds.shutdown(cancel_futures=True)
        self._phases.close()

    def cameras(self, scene: Scene, sensors: Sequence[SensorSpec]) -> dict[str, Camera]:
        """Cameras of ``sensors`` by name. Raises ServiceError: UNKNOWN_CAMERA, INVALID_REQUEST."""
        cameras = cameras_of(scene, sensors, max_pixels=self._max_pixels)
        return {s.camera: c for s, c in zip(sensors, cameras, strict=True)}

    def drawn_with(self, world: World, cameras: Mapping[str, Camera]) -> Scene | None:
        """With the sessions of which scene the next step of a world may be drawn; None for none.

        No session waits for the deformations of another.
        """
        sensors = world.spec.sensors
        if (
            not sensors
            or world.ranging
            or (world.deformation is not None and world.deformation.has_impacts)
        ):
            return None
        sizes = [cameras[sensor.camera] for sensor in sensors]
        return world.scene if self._renderer.draws_together(sensors, sizes) else None

    async def ranging_ready(
        self, ranging: RangingSensors, sensors: Sequence[SensorSpec], cameras: Mapping[str, Camera]
    ) -> None:
        """Wait until clouds of an episode can be made.

        Raises:
            ServiceError: INVALID_REQUEST for too many rays, or bytes beside those of raw images.
        """
        size = raw_image_bytes(sensors, [cameras[sensor.camera] for sensor in sensors])
        await self._clouds.ready(ranging, image_bytes=size)

    async def levels_ready(
        self,
        scene: Scene,
        state: ScenarioState,
        sensors: Sequence[SensorSpec],
        cameras: Mapping[str, Camera],
    ) -> None:
        """Wait until small images of a scenario have what they are drawn from, off the engine.

        Raises:
            ServiceError: OUT_OF_MEMORY.
        """
        sizes = [cameras[sensor.camera] for sensor in sensors]
        await self._renderer.ready(sensors, sizes, lambda: things_at_start(scene, state))

    async def edit_ready(self, world: World, cameras: Mapping[str, Camera]) -> None:
        """The same for a world that has just been edited, by what it shows now and later."""
        sensors = world.spec.sensors

        def shown() -> list[Instance]:
            scene, state = world.scene, world.state
            now = compose(scene, state, world.agents, min(world.t_us, scene.end_us))
            return [*now, *things_at_start(scene, state)]

        await self._renderer.ready(sensors, [cameras[s.camera] for s in sensors], shown)

    async def on_world_thread(self, fn: Callable[..., T], *args: Any) -> T:
        """``fn(*args)`` on the thread that moves worlds without sensors."""
        return await asyncio.get_running_loop().run_in_executor(self._worlds, fn, *args)

    # --- a change of the world ----------------------------------------------------------------

    async def run(self, transition: Transition) -> EncodedObservation:
        """Advance, render, evaluate, encode and send; the observation of the new world.

        Evaluation has ended when this returns or raises. Where it raises, nothing has happened but
        that the change may be on record.

        Raises:
            QueueFullError: too much waits for the engine.
        """
        observation: RenderedObservation | EncodedObservation
        if transition.cameras or transition.clouds:
            try:
                observation = await self._on_engine(transition)
            except KernelsMissingError:
                await self._phases.deformation.wait()
                observation = await self._on_engine(transition)
        else:
            observation = await self._steps.call(transition)
        return await self._finish(observation)

    def begin(
        self,
        transition: Transition,
        done: Callable[[EncodedObservation | Exception], object],
    ) -> None:
        """As :meth:`run`, of a world without sensors: ``done`` is called
        on the event loop with the observation, written where that could be done at once, or with
        what was raised. It must not raise."""

        def ended(outcome: EncodedObservation | Exception) -> None:
            if isinstance(outcome, Exception):
                done(outcome)
                return
            try:
                self.send(transition, outcome)
            except Exception as error:
                done(error)
                return
            done(outcome)
            self._count(outcome)

        self._steps.begin(transition, ended)

    async def _on_engine(self, transition: Transition) -> RenderedObservation | EncodedObservation:
        told = partial(self.send, transition)
        if transition.scene is None:
            return await self._engine.call(
                self._phases.compute, transition, label="drive", lane=Lane.DRIVE, on_result=told
            )
        return await self._engine.call_together(
            self._joint.draw,
            transition,
            key=transition.scene,
            share=share_of(transition.cameras.values()),
            label="drive",
            lane=Lane.DRIVE,
            on_result=told,
        )

    def send(
        self, transition: Transition, observation: RenderedObservation | EncodedObservation
    ) -> None:
        """Write the observation to the socket, if it is there already and nothing has to wait."""
        if transition.write is not None and isinstance(observation, EncodedObservation):
            transition.sent = transition.write(observation.answer)

    # --- a view of a world that stays as it is --------------------------------------------------

    async def view(
        self,
        world: World,
        sensors: Sequence[SensorSpec],
        *,
        ranging: RangingSensors = NO_SENSORS,
        slot: FrameSlot | None = None,
    ) -> EncodedObservation:
        """Images and clouds of a committed instant, from the vehicle; time does not move.

        Args:
            world: at that instant.
            sensors: what it is seen by.
            ranging: LiDARs and radars that look, too; all of them are due.
            slot: that raw images of the answer may be written to.

        Raises:
            ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels.
            QueueFullError: too much waits for the engine.
        """
        cameras = cameras_of(world.scene, sensors, max_pixels=self._max_pixels)
        things = partial(things_at_start, world.scene, world.state)
        await self._renderer.ready(sensors, cameras, things)
        await self._clouds.ready(ranging, image_bytes=raw_image_bytes(sensors, cameras))
        timer = PhaseTimer()
        view = partial(self._compute_view, world, sensors, cameras, timer, ranging)
        try:
            rendered = await self._engine.call(view, label="view")
        except KernelsMissingError:
            await self._phases.deformation.wait()
            rendered = await self._engine.call(view, label="view")
        return await self._finish(replace(rendered, slot=slot))

    def _compute_view(
        self,
        world: World,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        timer: PhaseTimer,
        ranging: RangingSensors,
    ) -> RenderedObservation:
        timer.stage("queue")
        self._phases.require_kernels(world)
        images: Images = ()
        if sensors:
            images = self._images.of(world, sensors, cameras, between=self._engine.give_way)
        timer.stage("render")
        clouds = self._phases.measure(world, ranging.all, timer)
        members = pack_members({"t_us": world.t_us, "revision": world.revision})
        return RenderedObservation(world, images, clouds, "view", members, timer)

    async def recorded_sweep(
        self, scene: Scene, state: ScenarioState, mounted: MountedLidar, t_us: int
    ) -> Cloud:
        """The sweep of a LiDAR on the recording vehicle that ends at ``t_us`` [us].

        Raises:
            ServiceError: INVALID_REQUEST for too many rays.
            TimeOutOfRangeError: ``t_us`` is outside the recording.
            QueueFullError: too much waits for the engine.
        """
        await self._clouds.ready(RangingSensors((mounted,)))
        cast = partial(self._clouds.recorded, scene, state, mounted, t_us)
        return await self._engine.call(cast, label="sweep")

    async def first_render(self, scene: Scene, state: ScenarioState) -> None:
        """Render a scene from its first camera, to have everything compiled and in memory.

        The picture is the worker's own and small: the limit of pixels is for those asked for.
        """
        camera = scene.rig[scene.rig.names[0]].resized(WARM_UP_WIDTH)
        request = RenderRequest(
            scene=scene,
            instances=instances_at(scene, state, scene.start_us),
            T_world_vehicle=scene.ego.transform(scene.start_us),
            t_us=scene.start_us,
            sensors=(SensorSpec(camera=camera.name, width=WARM_UP_WIDTH),),
        )
        draw = partial(self._renderer.render_images, between=self._engine.give_way)
        await self._engine.call(draw, request, [camera], label="warm-up")

    # --- inside ---------------------------------------------------------------------------------

    async def _finish(
        self, observation: RenderedObservation | EncodedObservation
    ) -> EncodedObservation:
        """The observation encoded, and counted once the answer is on its way."""
        if isinstance(observation, RenderedObservation):
            frames = await self._renderer.encode(observation.images)
            (observation,) = await self._renderer.on_encoders(
                lambda rendered: with_frames(rendered, frames), [observation]
            )
        asyncio.get_running_loop().call_soon(self._count, observation)
        return observation

    def _count(self, observation: EncodedObservation) -> None:
        self._metrics.stages.observe_ms(observation.timing_ms)
        for frame in observation.frames:
            self._metrics.frames.labels("drive", frame.codec).inc()
