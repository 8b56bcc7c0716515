"""The step pipeline: from a change of a session's world to its observation.

============  ==============  ====================================================================
phase         runs on         purpose
============  ==============  ====================================================================
``receive``   event loop      read and validate a message (`connection`)
``check``     event loop      check role, session and step of the action (`connection`)
``advance``   worlds, engine  advance a fork of the world, except for parts that images do not show
``render``    engine          deformations, then images and clouds of the due sensors
``evaluate``  worlds, during  metrics and events; write the log entry; pack the observation without
              rendering       its images
``encode``    event loop,     take raw images as they are; encode others or copy them into shared
              encoders        memory on the encoders; join the parts into one message
``send``      event loop      write the message to the socket (`connection`)
============  ==============  ====================================================================

A world without sensors needs no device. It advances on a separate thread, so that its planner does
not wait while other sessions are rendered.

Steps that wait for a thread at the same time are processed as a batch. Their log entries are
written in one transaction. If the backend supports it, their images are rendered in one pass,
bit-identical to separate rendering. No step waits for later ones.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

from real2sim_proto.episode import SensorSpec

from ...edit import ScenarioState, compose, instances_at, instances_at_start
from ...render import Instance
from ...scene import Camera, Scene
from ...world import World
from ...world.ranging import NO_SENSORS, Cloud, Mounted, MountedLidar, RangingSensors
from ..engine import Engine, Priority
from ..frames import EncodedFrame, RenderedImage, cloud_parts, needs_motion
from ..http.telemetry import Metrics
from ..renderer import Renderer, RenderRequest
from ..storage.store import Claim, SessionEntry, Store
from ..warm_up import DeformationKernels
from .sensors import WorldClouds, cameras_of, raw_image_bytes
from .shared_memory import FrameSlot
from .wire import EncodedMembers, EncodedMessage, PhaseTimer, pack_members, pack_with_frames

T = TypeVar("T")

WARM_UP_WIDTH = 320
MAX_TOGETHER = 16
"""Maximum batch of steps without sensors: the first waits a few milliseconds for the last."""
MAX_TOGETHER_DRAWN = 8
"""Maximum batch of steps with images."""
MAX_PIXELS_TOGETHER = 16_000_000
"""Maximum number of pixels in a batch of steps with images."""
MAX_WAITING = 1024
"""Maximum number of steps waiting for the world thread."""


@dataclass(frozen=True, eq=False)
class LogWrite:
    """Entries of a session's log to be stored.

    Attributes:
        store: the store.
        claim: the claim on the session.
        entries: the entries.
        instead: whether they replace all stored entries from the first one on.
    """

    store: Store
    claim: Claim
    entries: Sequence[SessionEntry]
    instead: bool


@dataclass(frozen=True, eq=False)
class EncodedObservation:
    """An observation as a message.

    Attributes:
        world: the observed world; not yet committed.
        frames: images of the message.
        message: complete message for all recipients.
        timing_ms: durations by stage.
        placed: message for the requesting client, if its images are in shared memory.
        clouds: point clouds of the message.
    """

    world: World
    frames: Sequence[EncodedFrame]
    message: EncodedMessage
    timing_ms: Mapping[str, float]
    placed: EncodedMessage | None = None
    clouds: Sequence[Cloud] = ()

    @property
    def answer(self) -> EncodedMessage:
        """The message for the requesting client."""
        return self.placed or self.message


@dataclass(eq=False)
class Step:
    """A change of a session's world, until its observation.

    Attributes:
        change: creates the new world, complete except for parts that images do not show, without
            modifying the current one; runs off the event loop.
        cameras: cameras of the world's sensors by name, at the requested sizes.
        clouds: whether to compute clouds of its LiDARs and radars.
        log: written once the new world is evaluated; None if it is already in the log.
        slot: shared memory slot for raw images.
        drawn_with: scene whose steps can be rendered in the same batch; None for no batching.
        timer: timer of the stages.
        world: the new world, after advancing.
        sensors, ranging: due sensors.
        images, measured: their results, in order.
        members: members of the message, without images, clouds and timing.
        recorded: whether ``log`` is written.
        error: error of a failed step.
    """

    change: Callable[[], World]
    cameras: Mapping[str, Camera]
    clouds: bool = False
    log: LogWrite | None = None
    slot: FrameSlot | None = None
    drawn_with: Scene | None = None
    timer: PhaseTimer = field(default_factory=PhaseTimer)
    world: World | None = None
    sensors: Sequence[SensorSpec] = ()
    ranging: Sequence[Mounted] = ()
    images: Sequence[RenderedImage] = ()
    measured: Sequence[Cloud] = ()
    members: EncodedMembers | None = None
    recorded: bool = False
    error: Exception | None = None

    @property
    def moved(self) -> World:
        """The new world of an advanced step."""
        assert self.world is not None
        return self.world

    @contextlib.contextmanager
    def catching(self) -> Iterator[None]:
        """Assign an error of the block to this step only."""
        try:
            yield
        except Exception as error:
            self.error = error


class KernelsMissingError(Exception):
    """An image has to wait for deformation kernels; the request had no effect."""


class StepPipeline:
    """Computes observations of changed worlds, and views of current ones.

    Args:
        engine: runs the rendering.
        renderer: renders and encodes.
        metrics: receives durations by stage.
        deformation: kernels for images after impacts.
        max_pixels: limit over all images of one step.
        max_rays: limit over all LiDARs and radars of one step.
        caster: name of the ray casting backend, see :func:`.cast`.
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
        self._deformation = deformation
        self._max_pixels = max_pixels
        self._clouds = WorldClouds(engine, max_rays=max_rays, caster=caster)
        self._worlds = Engine(name="worlds", queue_length=MAX_WAITING, threads=None)
        self._evaluators = ThreadPoolExecutor(1, thread_name_prefix="evaluate")

    def start(self) -> None:
        """Start the threads."""
        self._worlds.start()

    def close(self) -> None:
        """End the threads."""
        self._worlds.stop(drain=False)
        self._evaluators.shutdown(cancel_futures=True)

    # --- preparation before an episode begins ---------------------------------------------------

    def cameras(self, scene: Scene, sensors: Sequence[SensorSpec]) -> dict[str, Camera]:
        """Cameras of ``sensors`` by name. Raises ServiceError: UNKNOWN_CAMERA, INVALID_REQUEST."""
        cameras = cameras_of(scene, sensors, max_pixels=self._max_pixels)
        return {s.camera: c for s, c in zip(sensors, cameras, strict=True)}

    async def ranging_ready(
        self, ranging: RangingSensors, sensors: Sequence[SensorSpec], cameras: Mapping[str, Camera]
    ) -> None:
        """Wait until clouds of an episode can be computed.

        Raises:
            ServiceError: INVALID_REQUEST for too many rays, or for bytes that exceed the message
                size together with raw images.
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
        """Prepare the levels of detail for small images of a scenario, off the engine.

        Raises:
            ServiceError: OUT_OF_MEMORY.
        """
        sizes = [cameras[sensor.camera] for sensor in sensors]
        await self._renderer.ready(sensors, sizes, lambda: instances_at_start(scene, state))

    async def edit_ready(self, world: World, cameras: Mapping[str, Camera]) -> None:
        """Like :meth:`levels_ready`, for the current and later objects of an edited world."""
        sensors = world.spec.sensors

        def shown() -> list[Instance]:
            scene, state = world.scene, world.state
            now = compose(scene, state, world.agents, min(world.t_us, scene.end_us))
            return [*now, *instances_at_start(scene, state)]

        await self._renderer.ready(sensors, [cameras[s.camera] for s in sensors], shown)

    def drawn_with(self, world: World, cameras: Mapping[str, Camera]) -> Scene | None:
        """The scene whose sessions may share a rendering batch with the world's next step.

        None if the step cannot be batched, for example because its objects deform: other sessions
        do not wait for deformations.
        """
        sensors = world.spec.sensors
        deforms = world.deformation is not None and world.deformation.has_impacts
        if not sensors or world.ranging or deforms:
            return None
        sizes = [cameras[sensor.camera] for sensor in sensors]
        return world.scene if self._renderer.draws_together(sensors, sizes) else None

    async def on_world_thread(self, fn: Callable[..., T], *args: Any) -> T:
        """``fn(*args)`` on the thread that advances worlds without sensors."""
        return await self._worlds.call(fn, *args, label="world", priority=Priority.DRIVE)

    # --- a change of the world ------------------------------------------------------------------

    async def run(self, step: Step) -> EncodedObservation:
        """Advance, render, evaluate and encode; returns the observation of the new world.

        Evaluation has ended when this returns or raises. If it raises, nothing has changed, except
        that the change may be stored.

        Raises:
            QueueFullError: the thread's queue is full.
        """
        try:
            await self._compute_on_thread(step)
        except KernelsMissingError:
            await self._deformation.wait()
            step.error = None
            await self._compute_on_thread(step)
        return await self.encode(step, "obs")

    async def _compute_on_thread(self, step: Step) -> None:
        key: object
        if step.cameras or step.clouds:
            thread, key = self._engine, step.drawn_with or step
            pixels = sum(camera.width * camera.height for camera in step.cameras.values())
            share = max(pixels / MAX_PIXELS_TOGETHER, 1 / MAX_TOGETHER_DRAWN)
        else:
            thread, key, share = self._worlds, self, 1 / MAX_TOGETHER
        await thread.call_together(
            self.compute, step, key=key, share=share, label="drive", priority=Priority.DRIVE
        )

    def compute(self, steps: Sequence[Step]) -> list[Exception | None]:
        """Advance, render and evaluate a batch of steps; returns the error of each, or None.

        Failures do not affect the other steps.
        """
        for step in steps:
            step.timer.stage("queue")
        self.advance(steps)
        seeing = [step for step in steps if step.error is None and (step.sensors or step.ranging)]
        if seeing:
            evaluation = self._evaluators.submit(self.evaluate, steps)
            try:
                self.render(seeing)
            finally:
                evaluation.result()
        else:
            self.evaluate(steps)
        for step in steps:
            step.timer.stage("settle")
        return [step.error for step in steps]

    def advance(self, steps: Sequence[Step]) -> None:
        """Advance the worlds and find the due sensors.

        Parts of a world that images do not show are left to :meth:`evaluate`.
        """
        for step in steps:
            with step.catching():
                world = step.world = step.world or step.change()
                step.sensors = world.due_sensors()
                step.ranging = world.due_ranging() if step.clouds else ()
                if step.sensors or step.ranging:
                    self._require_kernels(world)
            step.timer.stage("world")

    def render(self, steps: Sequence[Step]) -> None:
        """Render the images and clouds of worlds, after deforming their objects."""
        for step in steps:
            with step.catching():
                _deform(step.moved, step.timer)
        drawn = [step for step in steps if step.sensors and step.error is None]
        try:
            self._draw(drawn)
        except Exception:
            # Then render them one by one, so that one failure does not affect the others.
            for step in drawn:
                with step.catching():
                    self._draw([step])
        for step in steps:
            step.timer.stage("render")
            if step.ranging:
                with step.catching():
                    step.measured = self._clouds.of(step.moved, step.ranging)
                step.timer.stage("cast")

    def evaluate(self, steps: Sequence[Step]) -> None:
        """Complete the worlds, write the log, and prepare the messages."""
        moved = [step for step in steps if step.world is not None and step.error is None]
        for step in moved:
            with step.catching():
                step.moved.evaluate()
        evaluated = [step for step in moved if step.error is None]
        record(evaluated)
        for step in evaluated:
            with step.catching():
                step.members = pack_members(step.moved.observe().obs_fields())

    async def encode(self, step: Step, kind: str) -> EncodedObservation:
        """The encoded observation; counted when the reply is sent."""
        frames = await self._renderer.encode(step.images)
        if step.measured or (frames and step.slot is not None):
            # Compressing clouds and copying to shared memory would delay the event loop.
            pack = partial(_packed, step, kind)
            (observation,) = await self._renderer.on_encoders(pack, [frames])
        else:
            observation = _packed(step, kind, frames)
        asyncio.get_running_loop().call_soon(self._count, observation)
        return observation

    def _draw(self, steps: Sequence[Step]) -> None:
        """Render the images of a batch of steps. If one fails, none has images."""
        requests = [(_request(s.moved, s.sensors), _cameras(s)) for s in steps]
        for step, images in zip(steps, self._renderer.render_together(requests), strict=True):
            step.images = _estimated(step.moved, images)

    def _require_kernels(self, world: World) -> None:
        """Raises KernelsMissingError if rendering a world would compile kernels on the engine.

        All sessions share the engine.
        """
        shapes = world.deformation
        if shapes is not None and shapes.has_impacts and not self._deformation.ready:
            raise KernelsMissingError

    # --- views of an unchanged world ------------------------------------------------------------

    async def view(
        self,
        world: World,
        sensors: Sequence[SensorSpec],
        *,
        ranging: RangingSensors = NO_SENSORS,
        slot: FrameSlot | None = None,
    ) -> EncodedObservation:
        """Images and clouds of a committed step, seen from the vehicle; time does not advance.

        Args:
            world: the world at that step.
            sensors: the cameras.
            ranging: LiDARs and radars, all due.
            slot: shared memory slot for raw images.

        Raises:
            ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels.
            QueueFullError: the engine's queue is full.
        """
        cameras = cameras_of(world.scene, sensors, max_pixels=self._max_pixels)
        things = partial(instances_at_start, world.scene, world.state)
        await self._renderer.ready(sensors, cameras, things)
        await self._clouds.ready(ranging, image_bytes=raw_image_bytes(sensors, cameras))
        step = Step(lambda: world, {}, slot=slot, world=world)
        step.members = pack_members({"t_us": world.t_us, "revision": world.revision})
        look = partial(self._look, step, sensors, cameras, ranging)
        try:
            await self._engine.call(look, label="view")
        except KernelsMissingError:
            await self._deformation.wait()
            await self._engine.call(look, label="view")
        return await self.encode(step, "view")

    def _look(
        self,
        step: Step,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        ranging: RangingSensors,
    ) -> None:
        step.timer.stage("queue")
        world = step.moved
        self._require_kernels(world)
        if sensors:
            requests = [(_request(world, sensors), cameras)]
            (images,) = self._renderer.render_together(
                requests, between=self._engine.yield_to_urgent
            )
            step.images = _estimated(world, images)
        step.timer.stage("render")
        if ranging:
            step.measured = self._clouds.of(world, ranging.all)
            step.timer.stage("cast")

    async def recorded_sweep(
        self, scene: Scene, state: ScenarioState, mounted: MountedLidar, t_us: int
    ) -> Cloud:
        """The sweep of a LiDAR on the recording vehicle that ends at ``t_us`` [us].

        Raises:
            ServiceError: INVALID_REQUEST for too many rays.
            TimeOutOfRangeError: ``t_us`` is outside the recording.
            QueueFullError: the engine's queue is full.
        """
        await self._clouds.ready(RangingSensors((mounted,)))
        cast = partial(self._clouds.recorded, scene, state, mounted, t_us)
        return await self._engine.call(cast, label="sweep")

    async def first_render(self, scene: Scene, state: ScenarioState) -> None:
        """Render a scene once from its first camera, to compile kernels and fill memory.

        The image is small and exempt from the pixel limit.
        """
        camera = scene.rig[scene.rig.names[0]].resized(WARM_UP_WIDTH)
        request = RenderRequest(
            scene=scene,
            instances=instances_at(scene, state, scene.start_us),
            T_world_vehicle=scene.ego.transform(scene.start_us),
            t_us=scene.start_us,
            sensors=(SensorSpec(camera=camera.name, width=WARM_UP_WIDTH),),
        )
        draw = partial(self._renderer.render_images, between=self._engine.yield_to_urgent)
        await self._engine.call(draw, request, [camera], label="warm-up")

    def _count(self, observation: EncodedObservation) -> None:
        self._metrics.stages.observe_ms(observation.timing_ms)
        for frame in observation.frames:
            self._metrics.frames.labels("drive", frame.codec).inc()


def record(steps: Sequence[Step]) -> None:
    """Write the log entries of steps, if possible in one transaction.

    Runs off the event loop. A failure affects only the step concerned.
    """
    logs = [(step, step.log) for step in steps if step.log is not None]
    if len(logs) > 1 and not any(log.instead for _, log in logs):
        with contextlib.suppress(Exception):
            store = logs[0][1].store
            store.record_together([(log.claim, log.entries) for _, log in logs])
            for step, _ in logs:
                step.recorded = True
            return
    for step, log in logs:
        with step.catching():
            log.store.record(log.claim, log.entries, instead=log.instead)
            step.recorded = True


def _packed(step: Step, kind: str, frames: Sequence[EncodedFrame]) -> EncodedObservation:
    """The messages of a step, with images included and with images in shared memory."""
    assert step.members is not None
    placed_frames = step.slot.place(frames) if step.slot is not None else None
    step.timer.stage("encode")
    clouds = [cloud_parts(cloud) for cloud in step.measured]
    pack = partial(pack_with_frames, kind, step.members, watch=step.timer, clouds=clouds)
    return EncodedObservation(
        step.moved,
        frames,
        pack(frames),
        step.timer.timing_ms,
        None if placed_frames is None else pack(placed_frames),
        step.measured,
    )


def _deform(world: World, timer: PhaseTimer) -> None:
    """Compute the deformed shapes in a world's images."""
    if world.deformation is not None:
        world.deformation.solve(world.t_us)
        timer.stage("physics")


def _request(world: World, sensors: Sequence[SensorSpec]) -> RenderRequest:
    moving = needs_motion(sensors)
    return RenderRequest(
        scene=world.scene,
        instances=world.moving_instances() if moving else world.instances(),
        T_world_vehicle=world.T_world_body,
        t_us=world.t_us,
        sensors=sensors,
        twist=world.twist if moving else None,
    )


def _cameras(step: Step) -> list[Camera]:
    return [step.cameras[sensor.camera] for sensor in step.sensors]


def _estimated(world: World, images: Sequence[RenderedImage]) -> Sequence[RenderedImage]:
    """Images from the true ego pose, labelled with the sensor poses of the ego's estimate."""
    if world.T_world_estimate is world.T_world_body:
        return images
    believed = []
    for image in images:
        assert image.camera is not None
        pose = image.camera.pose(world.T_world_estimate)
        believed.append(replace(image, T_world_sensor=pose))
    return believed
