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
phase: their log entries are one transaction, and they wake the event loop once.

Where the backend draws images of several worlds in one go (the serving kernels all, the CPU's small
ones), steps of sessions on one scene that wait
for the engine together pass the phases together, as far as TOGETHER_PIXELS: their images are those
that each would get alone, bit for bit. None waits for another that is not there yet, and one that
came first is left behind once at most.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple, TypeVar

from real2sim_proto import ErrorCode
from real2sim_proto.codec import MAX_SERVER_MESSAGE_BYTES
from real2sim_proto.episode import SensorSpec

from ...edit import ScenarioState, compose, instances_at, things_at_start
from ...geometry.transform import invert_transform
from ...render import Instance
from ...render.modalities import modality_of
from ...scene import Camera, Scene
from ...world import Observation, World
from ..accounts import Account, computing_account, count_sent, counted_world_time
from ..engine import Engine
from ..http.metrics import Metrics
from ..http.problems import ServiceError
from ..lanes import Lane
from ..rendering.frames import (
    EncodedFrame,
    FrameHeader,
    RenderedImage,
    raw_headers,
    with_pixels,
)
from ..rendering.renderer import Renderer, RenderRequest, check_sensors
from ..warm_up import DeformationKernels
from .gathered_calls import GatheredCalls, attempt
from .log_write import LogWrite, write_together
from .segment import FrameSlot
from .wire import EncodedMembers, EncodedMessage, PhaseTimer, pack_members, pack_with_frames

T = TypeVar("T")

WARM_UP_WIDTH = 320
TOGETHER_PIXELS = 16_000_000
"""Of images that are drawn in one go: the first session waits for the last, some milliseconds."""
MOST_TOGETHER = 8
"""Steps with images that are made in one go."""
MOST_OF_ONE_CLIENT = 64
"""The same of one client's message: nobody else gets the engine meanwhile."""
MAX_IMAGE_BYTES = MAX_SERVER_MESSAGE_BYTES - 1024 * 1024
"""Of raw images in one message; the rest of it fits in what is left of a reader's limit."""


@dataclass(eq=False)
class Transition:
    """A change of a session's world on its way through the pipeline.

    Attributes:
        change: makes the new world, complete as far as images show it, and leaves the present one
            alone; runs off the event loop.
        cameras: of the world's sensors, by name, at the sizes they name.
        record: writes the log entry of the change; runs off the event loop, once the new world is
            evaluated. None where it is in the log already.
        write: hands a message to the socket if nothing has to be waited for; whether it did. None
            where no action waits for it. Runs on the event loop; nothing fails after it.
        slot: that raw images of the answer may be written to.
        timer: of the stages.
        recorded: whether ``record`` is done.
        sent: whether ``write`` is done.
        account: that pays where no engine counts.
        scene: with the steps of which other sessions this may be drawn; None for none.
        moved: the new world, kept where its images have to wait for kernels.
    """

    change: Callable[[], World]
    cameras: Mapping[str, Camera]
    record: Callable[[], object] | None = None
    write: Callable[[EncodedMessage], bool] | None = None
    slot: FrameSlot | None = None
    timer: PhaseTimer = field(default_factory=PhaseTimer)
    recorded: bool = False
    sent: bool = False
    account: Account | None = None
    scene: Scene | None = None
    moved: World | None = None


Described = tuple[EncodedMembers, list[FrameHeader] | None]
"""An observation without its images, and the headers of these where all are raw."""


class _Moved(NamedTuple):
    """A new world as far as images show it, and the sensors that are due."""

    transition: Transition
    world: World
    sensors: Sequence[SensorSpec]
    cameras: Sequence[Camera]


class Seen(NamedTuple):
    """A world, and what the policy gets of it."""

    world: World
    observation: Observation


@dataclass(frozen=True, eq=False)
class RenderedObservation:
    """An instant before its images are encoded.

    Attributes:
        world: at that instant.
        images: in the order of sensors and modalities.
        kind, members: of the message, without frames and timing.
        timer: runs on.
        slot: that raw images of the answer may be written to.
    """

    world: World
    images: Sequence[RenderedImage]
    kind: str
    members: EncodedMembers
    timer: PhaseTimer
    slot: FrameSlot | None = None


@dataclass(frozen=True, eq=False)
class EncodedObservation:
    """An instant as a message.

    Attributes:
        world: at that instant; it is not committed by being shown.
        frames: the images of the message.
        message: for all who get it, whole.
        timing_ms: by stage.
        placed: for the client that is answered, where its images lie in shared memory.
    """

    world: World
    frames: Sequence[EncodedFrame]
    message: EncodedMessage
    timing_ms: Mapping[str, float]
    placed: EncodedMessage | None = None

    @property
    def answer(self) -> EncodedMessage:
        """For the client that is answered."""
        return self.placed or self.message


class _KernelsMissingError(Exception):
    """An image has to wait for kernels of deformation; nothing has happened."""


class StepPipeline:
    """Makes observations of changed worlds, and views of present ones.

    Args:
        engine: runs what is rendered.
        renderer: renders and encodes.
        metrics: gets durations by stage.
        deformation: kernels that images after impacts need.
        max_pixels: over all images of one instant.
    """

    def __init__(
        self,
        engine: Engine,
        renderer: Renderer,
        metrics: Metrics,
        *,
        deformation: DeformationKernels,
        max_pixels: int,
    ) -> None:
        self._engine = engine
        self._renderer = renderer
        self._metrics = metrics
        self._deformation = deformation
        self._max_pixels = max_pixels
        self._worlds = ThreadPoolExecutor(1, thread_name_prefix="worlds")
        self._steps: GatheredCalls[Transition, EncodedObservation] = GatheredCalls(
            self._compute_together, self._worlds, on_result=self.send
        )
        self._evaluators = ThreadPoolExecutor(1, thread_name_prefix="evaluate")

    def close(self) -> None:
        """End its threads."""
        self._worlds.shutdown(cancel_futures=True)
        self._evaluators.shutdown(cancel_futures=True)

    def cameras(self, scene: Scene, sensors: Sequence[SensorSpec]) -> dict[str, Camera]:
        """Cameras of ``sensors`` by name. Raises ServiceError: UNKNOWN_CAMERA, INVALID_REQUEST."""
        cameras = self._checked(scene, sensors)
        return {s.camera: c for s, c in zip(sensors, cameras, strict=True)}

    def drawn_with(self, world: World, cameras: Mapping[str, Camera]) -> Scene | None:
        """With the sessions of which scene the next step of a world may be drawn; None for none.

        No session waits for the deformations of another.
        """
        sensors = world.spec.sensors
        if not sensors or (world.deformation is not None and world.deformation.has_impacts):
            return None
        sizes = [cameras[sensor.camera] for sensor in sensors]
        return world.scene if self._renderer.draws_together(sensors, sizes) else None

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
        await self._renderer.levels.ready(sensors, sizes, lambda: things_at_start(scene, state))

    async def edit_ready(self, world: World, cameras: Mapping[str, Camera]) -> None:
        """The same for a world that has just been edited, by what it shows now and later."""
        sensors = world.spec.sensors

        def shown() -> list[Instance]:
            scene, state = world.scene, world.state
            now = compose(scene, state, world.agents, min(world.t_us, scene.end_us))
            return [*now, *things_at_start(scene, state)]

        await self._renderer.levels.ready(sensors, [cameras[s.camera] for s in sensors], shown)

    async def on_world_thread(self, fn: Callable[..., T], *args: Any) -> T:
        """``fn(*args)`` on the thread that moves worlds without sensors."""
        counted = partial(counted_world_time, await computing_account(), fn, *args)
        return await asyncio.get_running_loop().run_in_executor(self._worlds, counted)

    # --- a change of the world ----------------------------------------------------------------

    async def run(self, transition: Transition) -> EncodedObservation:
        """Advance, render, evaluate, encode and send; the observation of the new world.

        Evaluation has ended when this returns or raises. Where it raises, nothing has happened but
        that the change may be on record.

        Raises:
            QueueFullError: too much waits for the engine.
        """
        observation: RenderedObservation | EncodedObservation
        if transition.cameras:
            try:
                observation = await self._on_engine(transition)
            except _KernelsMissingError:
                await self._deformation.wait()
                observation = await self._on_engine(transition)
        else:
            transition.account = await computing_account()
            observation = await self._steps.call(transition)
        return await self._finish(observation)

    async def _on_engine(self, transition: Transition) -> RenderedObservation | EncodedObservation:
        told = partial(self.send, transition)
        if transition.scene is None:
            return await self._engine.call(
                self._compute, transition, label="drive", lane=Lane.DRIVE, on_result=told
            )
        return await self._engine.call_together(
            self._draw_together,
            transition,
            key=transition.scene,
            share=_share(transition.cameras.values()),
            label="drive",
            lane=Lane.DRIVE,
            on_result=told,
        )

    def _draw_together(
        self, transitions: Sequence[Transition]
    ) -> list[RenderedObservation | EncodedObservation | Exception]:
        """All phases of steps with images, drawn in one go; where one fails, the others go on."""
        if len(transitions) == 1:
            return [attempt(self._compute, transitions[0])]
        for transition in transitions:
            transition.timer.stage("queue")
        begun = [attempt(self._moved, transition) for transition in transitions]
        present = [moved for moved in begun if isinstance(moved, _Moved)]
        for moved in present:
            moved.transition.timer.stage("world")
        evaluation = self._evaluators.submit(self._evaluate_together, present)
        try:
            images = self._render_together(present)
        finally:
            evaluation.exception()  # waits
        finished = iter(map(self._completed, present, images, evaluation.result()))
        return [moved if isinstance(moved, Exception) else next(finished) for moved in begun]

    def _moved(self, transition: Transition) -> _Moved:
        world = self.advance(transition)
        sensors = world.due_sensors()
        if sensors:
            self._require_kernels(world)
        return _Moved(transition, world, sensors, [transition.cameras[s.camera] for s in sensors])

    def _render_together(
        self, present: Sequence[_Moved]
    ) -> list[Sequence[RenderedImage] | Exception]:
        """Images of each world, its objects deformed first, or what was raised instead."""
        deformed = [attempt(_deform, moved.world, moved.transition.timer) for moved in present]
        ready = [m for m, error in zip(present, deformed, strict=True) if error is None]
        try:
            drawn = self._images_together([(m.world, m.sensors, m.cameras) for m in ready])
        except Exception:
            # Each then finds out for itself: the trouble of one is not that of the others.
            alone = (attempt(self._images, m.world, m.sensors, m.cameras) for m in ready)
            found: Iterator[Sequence[RenderedImage] | Exception] = iter(list(alone))
        else:
            found = iter(drawn)
        for moved in present:
            moved.transition.timer.stage("render")
        return [next(found) if error is None else error for error in deformed]

    def _evaluate_together(self, present: Sequence[_Moved]) -> list[Described | Exception]:
        """As :meth:`evaluate` for each, their log entries put on record together."""
        failed: dict[Transition, Exception] = {}
        for moved in present:
            if isinstance(error := attempt(moved.world.evaluate), Exception):
                failed[moved.transition] = error
        failed |= self._record([m.transition for m in present if m.transition not in failed])
        return [
            failed[m.transition]
            if m.transition in failed
            else attempt(_described, m.world, m.sensors, m.cameras)
            for m in present
        ]

    def _completed(
        self,
        moved: _Moved,
        images: Sequence[RenderedImage] | Exception,
        described: Described | Exception,
    ) -> RenderedObservation | EncodedObservation | Exception:
        for outcome in (described, images):
            if isinstance(outcome, Exception):
                return outcome
        assert not isinstance(images, Exception)
        assert not isinstance(described, Exception)
        return attempt(self._observation, moved.transition, moved.world, images, described)

    def _observation(
        self,
        transition: Transition,
        world: World,
        images: Sequence[RenderedImage],
        described: Described,
    ) -> RenderedObservation | EncodedObservation:
        """Of a rendered and evaluated world, encoded where all images are raw."""
        members, headers = described
        # Of the evaluation only what did not happen beside the rendering.
        transition.timer.stage("settle")
        rendered = RenderedObservation(
            world, images, "obs", members, transition.timer, transition.slot
        )
        return rendered if headers is None else self.encode(rendered, headers)

    def _compute_together(
        self, transitions: Sequence[Transition]
    ) -> list[EncodedObservation | Exception]:
        """All phases of steps without images; where one fails, the others go on."""
        if len(transitions) == 1:
            return _counted(self._compute_blind, [(transitions[0],)])
        worlds = self._worlds_of(transitions)
        pairs = zip(transitions, worlds, strict=True)
        encoded = iter(_counted(self._encode_blind, [p for p in pairs if isinstance(p[1], World)]))
        return [next(encoded) if isinstance(world, World) else world for world in worlds]

    async def run_seeing(
        self, transitions: Sequence[Transition]
    ) -> list[EncodedObservation | Exception]:
        """Advance, render, evaluate and encode worlds with sensors, drawn in one go as far as
        TOGETHER_PIXELS and MOST_OF_ONE_CLIENT: the observation of each, or what it has failed by.
        """
        found: list[EncodedObservation | Exception] = []
        for piece in _pieces(transitions):
            try:
                drawn = await self._engine.call(
                    self._draw_together, piece, label="drive", lane=Lane.DRIVE
                )
            except Exception as error:
                found += [error] * len(piece)
                continue
            encoded = (self._encoded(t, o) for t, o in zip(piece, drawn, strict=True))
            found += await asyncio.gather(*encoded)
        return found

    async def _encoded(
        self,
        transition: Transition,
        drawn: RenderedObservation | EncodedObservation | Exception,
    ) -> EncodedObservation | Exception:
        try:
            if isinstance(drawn, _KernelsMissingError):
                return await self.run(transition)
            return drawn if isinstance(drawn, Exception) else await self._finish(drawn)
        except Exception as error:
            return error

    async def run_together(self, transitions: Sequence[Transition]) -> list[Seen | Exception]:
        """Advance, evaluate and record, in one go: the new worlds and what is seen of them, or what
        each has failed by.

        For worlds without sensors, whose observations somebody else encodes.

        Raises:
            OverLimitError: the account of the running task has had its time on the engine.
        """
        return await self.on_world_thread(self._see_together, transitions)

    def _see_together(self, transitions: Sequence[Transition]) -> list[Seen | Exception]:
        return [
            world if isinstance(world, Exception) else attempt(_seen, world)
            for world in self._worlds_of(transitions)
        ]

    def _worlds_of(self, transitions: Sequence[Transition]) -> list[World | Exception]:
        worlds = _counted(self._advance_and_evaluate, [(transition,) for transition in transitions])
        moved = [t for t, w in zip(transitions, worlds, strict=True) if isinstance(w, World)]
        unrecorded = self._record(moved)
        return [unrecorded.get(t, w) for t, w in zip(transitions, worlds, strict=True)]

    def _compute_blind(self, transition: Transition) -> EncodedObservation:
        observation = self._compute(transition)
        assert isinstance(observation, EncodedObservation)
        return observation

    def _advance_and_evaluate(self, transition: Transition) -> World:
        timer = transition.timer
        timer.stage("queue")
        world = self.advance(transition)
        timer.stage("world")
        timer.stage("render")
        world.evaluate()
        return world

    def _record(self, transitions: Sequence[Transition]) -> dict[Transition, Exception]:
        """Put changes on record, together where that can be; those for which it failed."""
        writes = [t.record for t in transitions if t.record is not None]
        logs = [w for w in writes if isinstance(w, LogWrite) and not w.instead]
        if len(logs) == len(transitions) > 1:
            try:
                write_together(logs)
            except Exception:
                # Each then finds out for itself: the trouble of one is not that of the others.
                pass
            else:
                for transition in transitions:
                    transition.recorded = True
                return {}
        failed: dict[Transition, Exception] = {}
        for transition in transitions:
            if isinstance(error := attempt(_record_one, transition), Exception):
                failed[transition] = error
        return failed

    def _encode_blind(self, transition: Transition, world: World) -> EncodedObservation:
        members = pack_members(world.observe().obs_fields())
        transition.timer.stage("settle")
        return self.encode(RenderedObservation(world, (), "obs", members, transition.timer), ())

    def _compute(self, transition: Transition) -> RenderedObservation | EncodedObservation:
        """The phases of one job, which ends encoded where all images are raw."""
        timer = transition.timer
        timer.stage("queue")
        _, world, sensors, cameras = self._moved(transition)
        timer.stage("world")
        images: Sequence[RenderedImage] = ()
        if sensors:
            evaluation = self._evaluators.submit(self.evaluate, transition, world, sensors, cameras)
            try:
                images = self.render(world, sensors, cameras, timer)
            finally:
                evaluation.exception()  # waits
            described = evaluation.result()
        else:
            timer.stage("render")
            described = self.evaluate(transition, world, sensors, cameras)
        return self._observation(transition, world, images, described)

    def advance(self, transition: Transition) -> World:
        """The new world, as far as images show it."""
        if transition.moved is None:
            transition.moved = transition.change()
        return transition.moved

    def render(
        self,
        world: World,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        timer: PhaseTimer,
    ) -> Sequence[RenderedImage]:
        """Images of a world, its objects deformed first."""
        _deform(world, timer)
        images = self._images(world, sensors, cameras)
        timer.stage("render")
        return images

    def evaluate(
        self,
        transition: Transition,
        world: World,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
    ) -> Described:
        """Complete the world by what images do not show, and put the change on record."""
        world.evaluate()
        _record_one(transition)
        return _described(world, sensors, cameras)

    def encode(
        self, rendered: RenderedObservation, headers: Sequence[FrameHeader]
    ) -> EncodedObservation:
        """The message of an instant whose images are all raw."""
        for image in rendered.images:
            image.ready()
        frames = [with_pixels(h, i.pixels) for h, i in zip(headers, rendered.images, strict=True)]
        return _with_frames(rendered, frames)

    def send(
        self, transition: Transition, observation: RenderedObservation | EncodedObservation
    ) -> None:
        """Write the observation to the socket, if it is there already and nothing has to wait."""
        if transition.write is not None and isinstance(observation, EncodedObservation):
            transition.sent = transition.write(observation.answer)

    # --- a view of a world that stays as it is --------------------------------------------------

    async def view(
        self, world: World, sensors: Sequence[SensorSpec], *, slot: FrameSlot | None = None
    ) -> EncodedObservation:
        """Images of a committed instant, from cameras of the vehicle; time does not move.

        Args:
            world: at that instant.
            sensors: what it is seen by.
            slot: that raw images of the answer may be written to.

        Raises:
            ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels.
            QueueFullError: too much waits for the engine.
        """
        cameras = self._checked(world.scene, sensors)
        things = partial(things_at_start, world.scene, world.state)
        await self._renderer.levels.ready(sensors, cameras, things)
        timer = PhaseTimer()
        view = partial(self._compute_view, world, sensors, cameras, timer)
        try:
            rendered = await self._engine.call(view, label="view")
        except _KernelsMissingError:
            await self._deformation.wait()
            rendered = await self._engine.call(view, label="view")
        return await self._finish(replace(rendered, slot=slot))

    def _compute_view(
        self,
        world: World,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        timer: PhaseTimer,
    ) -> RenderedObservation:
        timer.stage("queue")
        self._require_kernels(world)
        images = self._images(world, sensors, cameras, between=self._engine.give_way)
        timer.stage("render")
        members = pack_members({"t_us": world.t_us, "revision": world.revision})
        return RenderedObservation(world, images, "view", members, timer)

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

    def _checked(self, scene: Scene, sensors: Sequence[SensorSpec]) -> list[Camera]:
        cameras = check_sensors(scene.rig, sensors, max_pixels=self._max_pixels)
        size = raw_image_bytes(sensors, cameras)
        if size > MAX_IMAGE_BYTES:
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"{size} bytes of raw images in one message; readers allow {MAX_IMAGE_BYTES}",
                hint="ask for smaller or fewer images, or for codec 'jpeg' or 'png'",
            )
        return cameras

    def _require_kernels(self, world: World) -> None:
        """Raises _KernelsMissingError where images of a world would compile on the engine, which
        belongs to all sessions."""
        shapes = world.deformation
        if shapes is not None and shapes.has_impacts and not self._deformation.ready:
            raise _KernelsMissingError

    def _images(
        self,
        world: World,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        *,
        between: Callable[[], object] | None = None,
    ) -> Sequence[RenderedImage]:
        return self._images_together([(world, sensors, cameras)], between=between)[0]

    def _images_together(
        self,
        worlds: Sequence[tuple[World, Sequence[SensorSpec], Sequence[Camera]]],
        *,
        between: Callable[[], object] | None = None,
    ) -> list[Sequence[RenderedImage]]:
        requests = [(_request(world, sensors), cameras) for world, sensors, cameras in worlds]
        drawn = self._renderer.render_together(requests, between=between)
        return [_believed(world, images) for (world, *_), images in zip(worlds, drawn, strict=True)]

    async def _finish(
        self, observation: RenderedObservation | EncodedObservation
    ) -> EncodedObservation:
        """The observation encoded, and counted once the answer is on its way."""
        if isinstance(observation, RenderedObservation):
            frames = await self._renderer.encode(observation.images)
            (observation,) = await self._renderer.on_encoders(
                lambda rendered: _with_frames(rendered, frames), [observation]
            )
        if observation.placed is not None:
            count_sent(sum(len(f.data) for f in observation.frames if f.codec == "raw"))
        asyncio.get_running_loop().call_soon(self._count, observation)
        return observation

    def _count(self, observation: EncodedObservation) -> None:
        for stage, ms in observation.timing_ms.items():
            self._metrics.stages.labels(stage).observe(ms / 1e3)
        for frame in observation.frames:
            self._metrics.frames.labels("drive", frame.codec).inc()


def _counted(fn: Callable[..., T], calls: Iterable[tuple[Any, ...]]) -> list[T | Exception]:
    """A part of several steps on the thread of worlds, its time counted for whoever asked for it;
    the transaction of several steps counts for nobody.

    ``calls`` are arguments of ``fn``, the transition first. Those of one account in a row are
    counted in one go: every look at the clock of the processor is a call of the system.
    """
    found: list[T | Exception] = []
    for account, run in groupby(calls, key=lambda call: call[0].account):
        found += counted_world_time(account, _attempts, fn, list(run))
    return found


def _attempts(fn: Callable[..., T], calls: Sequence[tuple[Any, ...]]) -> list[T | Exception]:
    return [attempt(fn, *call) for call in calls]


def _seen(world: World) -> Seen:
    return Seen(world, world.observe())


def message_of(world: World) -> EncodedMessage:
    """The observation of an instant without images, as a message."""
    members = pack_members(world.observe().obs_fields())
    return pack_with_frames("obs", members, (), PhaseTimer())


def raw_image_bytes(sensors: Sequence[SensorSpec], cameras: Iterable[Camera]) -> int:
    """Of the raw images of one instant; ``cameras``: of the sensors, in their order."""
    return sum(
        modality_of(modality).raw_bytes(camera.width, camera.height)
        for camera, sensor in zip(cameras, sensors, strict=True)
        for modality in sensor.modalities
        if sensor.codec == "raw"
    )


def _pieces(transitions: Sequence[Transition]) -> list[list[Transition]]:
    """What is drawn in one go of many."""
    pieces: list[list[Transition]] = []
    room = 0
    for transition in transitions:
        pixels = sum(camera.width * camera.height for camera in transition.cameras.values())
        room -= pixels
        if room < 0 or not pieces or len(pieces[-1]) == MOST_OF_ONE_CLIENT:
            pieces.append([])
            room = TOGETHER_PIXELS - pixels
        pieces[-1].append(transition)
    return pieces


def _share(cameras: Iterable[Camera]) -> float:
    """How much of what is drawn in one go is for a session with these cameras."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    return max(pixels / TOGETHER_PIXELS, 1 / MOST_TOGETHER)


def _deform(world: World, timer: PhaseTimer) -> None:
    """Find the shapes that images of a world show."""
    if world.deformation is not None:
        world.deformation.solve(world.t_us)
        timer.stage("physics")


def _request(world: World, sensors: Sequence[SensorSpec]) -> RenderRequest:
    return RenderRequest(
        scene=world.scene,
        instances=world.instances(),
        T_world_vehicle=world.T_world_body,
        t_us=world.t_us,
        sensors=sensors,
    )


def _believed(world: World, images: Sequence[RenderedImage]) -> Sequence[RenderedImage]:
    """Images are of where the ego is; what they say of it is its own estimate."""
    if world.T_world_estimate is world.T_world_body:
        return images
    believed = world.T_world_estimate @ invert_transform(world.T_world_body)
    return [replace(i, T_world_sensor=believed @ i.T_world_sensor) for i in images]


def _described(world: World, sensors: Sequence[SensorSpec], cameras: Sequence[Camera]) -> Described:
    members = pack_members(world.observe().obs_fields())
    if any(sensor.codec != "raw" for sensor in sensors):
        return members, None
    return members, raw_headers(sensors, cameras, world.T_world_estimate, world.t_us)


def _record_one(transition: Transition) -> None:
    if transition.record is not None:
        transition.record()
        transition.recorded = True


def _with_frames(
    rendered: RenderedObservation, frames: Sequence[EncodedFrame]
) -> EncodedObservation:
    kind, members, timer = rendered.kind, rendered.members, rendered.timer
    lying = rendered.slot.place(frames) if rendered.slot is not None else None
    timer.stage("encode")
    message = pack_with_frames(kind, members, frames, timer)
    placed = pack_with_frames(kind, members, lying, timer) if lying is not None else None
    return EncodedObservation(rendered.world, frames, message, timer.timing_ms, placed)
