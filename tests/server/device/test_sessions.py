"""Batched steps of several sessions on one scene give the same images as separate steps."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, TypeVar, cast

import pytest

from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import Control
from real2sim_server.edit import ScenarioState
from real2sim_server.render import RenderOutput
from real2sim_server.render._cpu.backend import CpuBackend
from real2sim_server.render._cuda.serving import NvrtcBackend
from real2sim_server.render.backend import Backend, RasterRequest
from real2sim_server.scene import Scene
from real2sim_server.service.engine import Engine
from real2sim_server.service.http.telemetry import Metrics
from real2sim_server.service.renderer import Renderer
from real2sim_server.service.sessions.pipeline import (
    EncodedObservation,
    LogWrite,
    Step,
    StepPipeline,
)
from real2sim_server.world import World
from tests.waiting import LIMIT_S, wait_until_async

from ..render.kernel_twin import COMPILER, NEEDS_COMPILER
from . import pretended
from .pretended_launcher import PretendedLauncher

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NEEDS_COMPILER)
T = TypeVar("T")
SENSORS: list[dict[str, Any]] = [
    {"camera": "front", "width": 48, "codec": "raw", "modalities": ["rgb", "depth", "instance"]},
    {"camera": "left", "width": 32, "codec": "raw", "modalities": ["rgb", "depth", "instance"]},
]
SPEC: dict[str, Any] = {"action": "control", "sensors": SENSORS}


class Service:
    """Engine and step pipeline on the pretended device."""

    def __init__(self, backend: Backend) -> None:
        self.engine = Engine()
        self.engine.start()
        metrics = Metrics()
        renderer = Renderer(self.engine, backend, metrics, max_pixels=10**7)
        self.pipeline = StepPipeline(
            self.engine,
            renderer,
            metrics,
            deformation=cast(Any, None),
            max_pixels=10**7,
            max_rays=10**6,
        )
        self.pipeline.start()
        self._closing = [self.pipeline.close, renderer.close, self.engine.stop]

    def close(self) -> None:
        for close in self._closing:
            close()

    def step(self, world: World, steering: float) -> Step:
        cameras = self.pipeline.cameras(world.scene, world.spec.sensors)
        scene = self.pipeline.drawn_with(world, cameras)
        return Step(partial(moved, world, steering), cameras, drawn_with=scene)

    def run(self, *steps: Awaitable[T]) -> list[T | BaseException]:
        """Results of steps that wait for the engine at the same time."""
        entered, opened = threading.Event(), threading.Event()

        def gate() -> None:
            entered.set()
            assert opened.wait(LIMIT_S)

        async def all_of_them() -> list[T | BaseException]:
            busy = asyncio.create_task(self.engine.call(gate))
            assert await asyncio.to_thread(entered.wait, LIMIT_S)
            tasks = [asyncio.ensure_future(step) for step in steps]
            await wait_until_async(
                lambda: self.engine.queue_depth >= len(steps) or any(t.done() for t in tasks),
                "all steps to wait for the engine",
            )
            pretended.counts.__init__()  # type: ignore[misc]
            opened.set()
            await busy
            return await asyncio.gather(*tasks, return_exceptions=True)

        return asyncio.run(all_of_them())


@pytest.fixture
def service(device_counts: pretended.Counts) -> Iterator[Service]:
    made = Service(NvrtcBackend(PretendedLauncher()))
    yield made
    made.close()


def moved(world: World, steering: float) -> World:
    fork = world.fork()
    fork.move(Control(acceleration=1.0, steering=steering))
    return fork


def begun(scene: Scene, **spec: Any) -> World:
    return World(scene, ScenarioState.of(scene), ResetSpec(**SPEC | spec))


def images(observation: EncodedObservation | BaseException) -> list[bytes]:
    assert isinstance(observation, EncodedObservation), observation
    return [bytes(frame.data) for frame in observation.frames]


@pytest.mark.parametrize("codec", ["raw", "png"])
def test_two_sessions_share_launches_and_get_the_same_images_as_alone(
    service: Service, tiny_scene: Scene, device_counts: pretended.Counts, codec: str
) -> None:
    sensors = [sensor | {"codec": codec} for sensor in SENSORS]
    worlds = [begun(tiny_scene, sensors=sensors, start_us=start) for start in (0, 500_000)]

    def steps() -> list[Awaitable[EncodedObservation]]:
        given = zip(worlds, (0.1, -0.2), strict=True)
        return [service.pipeline.run(service.step(world, angle)) for world, angle in given]

    alone = [images(service.run(step)[0]) for step in steps()]
    launches = device_counts.launches
    counted = (device_counts.to_device, device_counts.to_host, device_counts.waits)
    together = [images(observation) for observation in service.run(*steps())]
    assert together == alone
    assert together[0] != together[1]
    assert device_counts.launches == launches
    assert (device_counts.to_device, device_counts.to_host, device_counts.waits) == counted
    assert device_counts.to_device == 1


def test_small_images_of_two_sessions_are_batched_on_the_cpu(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = CpuBackend()
    batches: list[int] = []
    draw = backend.rasterize_batch

    def noted(requests: Sequence[RasterRequest]) -> RenderOutput:
        batches.append(len(requests))
        return draw(requests)

    monkeypatch.setattr(backend, "rasterize_batch", noted)
    service = Service(backend)
    try:
        worlds = [begun(tiny_scene), begun(tiny_scene, start_us=500_000)]
        steps = [
            lambda world=world: service.pipeline.run(service.step(world, 0.1)) for world in worlds
        ]
        alone = [images(service.run(step())[0]) for step in steps]
        batches.clear()
        together = service.run(*(step() for step in steps))
        assert [images(observation) for observation in together] == alone
        # One batch for each size.
        assert batches == [2, 2]
        large = [sensor | {"detail": "full"} for sensor in SENSORS]
        assert service.step(begun(tiny_scene, sensors=large), 0.1).drawn_with is None
    finally:
        service.close()


def test_a_failing_session_does_not_affect_the_others_in_its_batch(
    service: Service, tiny_scene: Scene
) -> None:
    world = begun(tiny_scene)
    sound, refused, unrecorded = (service.step(world, 0.1) for _ in range(3))

    def fail(*_: object, **__: object) -> World:
        raise ValueError("no")

    store = cast(Any, SimpleNamespace(record=fail))
    refused.change, unrecorded.log = fail, LogWrite(store, cast(Any, None), (), instead=False)
    ran = (service.pipeline.run(step) for step in (refused, sound, unrecorded))
    found = service.run(*ran)
    assert [isinstance(outcome, ValueError) for outcome in found] == [True, False, True]
    assert images(found[1]) == images(
        service.run(service.pipeline.run(service.step(world, 0.1)))[0]
    )


def test_a_failed_render_affects_only_its_session(service: Service, tiny_scene: Scene) -> None:
    sound, broken = (service.step(begun(tiny_scene), 0.1) for _ in range(2))
    change = broken.change

    def bent() -> World:
        world = change()
        world.T_world_body = 2.0 * world.T_world_body
        return world

    broken.change = bent
    found = service.run(*map(service.pipeline.run, (sound, broken)))
    assert isinstance(found[0], EncodedObservation)
    assert "rigid" in str(found[1])
