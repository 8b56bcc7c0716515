"""Images of worlds: what cameras see of objects, deformed ones and the ego's own estimate."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from real2sim_proto.episode import SensorSpec

from ...geometry.transform import invert_transform
from ...scene import Camera
from ...world import World
from ..rendering.frames import RenderedImage
from ..rendering.optics import needs_motion
from ..rendering.renderer import Renderer, RenderRequest
from .gathered_calls import attempt
from .wire import PhaseTimer

Images = Sequence[RenderedImage]
Seeing = tuple[World, Sequence[SensorSpec], Sequence[Camera]]
"""A world, the sensors that are due, and their cameras."""


class WorldImages:
    """Draws on the engine's thread.

    Args:
        renderer: draws.
    """

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer

    def of_each(self, worlds: Sequence[Seeing]) -> list[Images | Exception]:
        """Images of each world, drawn in one go; where one fails, the others are drawn."""
        try:
            drawn: Iterator[Images | Exception] = iter(self.of_all(worlds))
        except Exception:
            # Each then finds out for itself: the trouble of one is not that of the others.
            drawn = iter([attempt(self.of, *world) for world in worlds])
        return list(drawn)

    def of(
        self,
        world: World,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        *,
        between: Callable[[], object] | None = None,
    ) -> Images:
        """Images of one world; ``between`` is called between pieces of the work."""
        return self.of_all([(world, sensors, cameras)], between=between)[0]

    def of_all(
        self, worlds: Sequence[Seeing], *, between: Callable[[], object] | None = None
    ) -> list[Images]:
        """Images of each world, drawn in one go, or none where one of them fails."""
        requests = [(_request(world, sensors), cameras) for world, sensors, cameras in worlds]
        drawn = self._renderer.render_together(requests, between=between)
        return [_believed(world, images) for (world, *_), images in zip(worlds, drawn, strict=True)]


def deform(world: World, timer: PhaseTimer) -> None:
    """Find the shapes that images of a world show."""
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


def _believed(world: World, images: Images) -> Images:
    """Images are of where the ego is; what they say of it is its own estimate."""
    if world.T_world_estimate is world.T_world_body:
        return images
    believed = world.T_world_estimate @ invert_transform(world.T_world_body)
    return [replace(i, T_world_sensor=believed @ i.T_world_sensor) for i in images]
