"""The phases of a step between the event loop and the socket; `pipeline` says which runs where."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from real2sim_proto.episode import SensorSpec

from ...scene import Camera
from ...world import World
from ...world.ranging import Cloud, Mounted
from ..rendering.frames import FrameHeader, with_pixels
from ..warm_up import DeformationKernels
from .observation import (
    Described,
    EncodedObservation,
    RenderedObservation,
    describe,
    with_frames,
)
from .transition import Transition, record
from .wire import PhaseTimer
from .world_clouds import WorldClouds
from .world_images import Images, WorldImages, deform


class Moved(NamedTuple):
    """A new world as far as images show it, and the cameras, LiDARs and radars that are due."""

    transition: Transition
    world: World
    sensors: Sequence[SensorSpec]
    cameras: Sequence[Camera]
    due: Sequence[Mounted]


class KernelsMissingError(Exception):
    """An image has to wait for kernels of deformation; nothing has happened."""


class StepPhases:
    """Each phase of a step, and all of them for a single one.

    Args:
        images: of worlds.
        clouds: of worlds.
        deformation: see there.

    Attributes:
        deformation: kernels that images after impacts need.
        evaluators: the thread beside the rendering.
    """

    def __init__(
        self, images: WorldImages, clouds: WorldClouds, deformation: DeformationKernels
    ) -> None:
        self.evaluators = ThreadPoolExecutor(1, thread_name_prefix="evaluate")
        self._images = images
        self._clouds = clouds
        self.deformation = deformation

    def close(self) -> None:
        """End its thread."""
        self.evaluators.shutdown(cancel_futures=True)

    def compute(self, transition: Transition) -> RenderedObservation | EncodedObservation:
        """The phases of one job, which ends encoded where all images are raw."""
        timer = transition.timer
        timer.stage("queue")
        _, world, sensors, cameras, due = self.begin(transition)
        timer.stage("world")
        images: Images = ()
        clouds: Sequence[Cloud] = ()
        if sensors or due:
            evaluation = self.evaluators.submit(self.evaluate, transition, world, sensors, cameras)
            try:
                images = self.render(world, sensors, cameras, timer)
                clouds = self.measure(world, due, timer)
            finally:
                evaluation.exception()  # waits
            described = evaluation.result()
        else:
            timer.stage("render")
            described = self.evaluate(transition, world, sensors, cameras)
        return self.observation(transition, world, images, described, clouds=clouds)

    def begin(self, transition: Transition) -> Moved:
        """The new world with the sensors that are due. Raises KernelsMissingError."""
        world = self.advance(transition)
        sensors = world.due_sensors()
        due = world.due_ranging() if transition.clouds else ()
        if sensors or due:
            self.require_kernels(world)
        cameras = [transition.cameras[s.camera] for s in sensors]
        return Moved(transition, world, sensors, cameras, due)

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
    ) -> Images:
        """Images of a world, its objects deformed first."""
        deform(world, timer)
        images = self._images.of(world, sensors, cameras) if sensors else ()
        timer.stage("render")
        return images

    def measure(self, world: World, due: Sequence[Mounted], timer: PhaseTimer) -> list[Cloud]:
        """Clouds of a world whose objects are deformed already."""
        clouds = self._clouds.of(world, due)
        if due:
            timer.stage("cast")
        return clouds

    def evaluate(
        self,
        transition: Transition,
        world: World,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
    ) -> Described:
        """Complete the world by what images do not show, and put the change on record."""
        world.evaluate()
        record(transition)
        return describe(world, sensors, cameras)

    def observation(
        self,
        transition: Transition,
        world: World,
        images: Images,
        described: Described,
        *,
        clouds: Sequence[Cloud] = (),
    ) -> RenderedObservation | EncodedObservation:
        """Of a rendered and evaluated world, encoded where all images and clouds are raw."""
        members, headers = described
        # Of the evaluation only what did not happen beside the rendering.
        transition.timer.stage("settle")
        rendered = RenderedObservation(
            world, images, clouds, "obs", members, transition.timer, transition.slot
        )
        if headers is None or any(cloud.codec != "raw" for cloud in clouds):
            return rendered
        return self.encode(rendered, headers)

    def encode(
        self, rendered: RenderedObservation, headers: Sequence[FrameHeader]
    ) -> EncodedObservation:
        """The message of an instant whose images are all raw."""
        for image in rendered.images:
            image.ready()
        frames = [with_pixels(h, i.pixels) for h, i in zip(headers, rendered.images, strict=True)]
        return with_frames(rendered, frames)

    def require_kernels(self, world: World) -> None:
        """Raises KernelsMissingError where images of a world would compile on the engine, which
        belongs to all sessions."""
        shapes = world.deformation
        if shapes is not None and shapes.has_impacts and not self.deformation.ready:
            raise KernelsMissingError
