"""What the rays of a sensor meet in a world: surfaces, and how they have moved past it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...edit.compose import compose
from ...edit.sweep import met_background, met_object
from ...geometry.rotation import Float
from ...render.cast.recorded import Attributes, SweepScene, incidence_of
from ...render.cast.types import CastRequest
from ...render.types import Instance
from ...scene import Lidar
from ..world import World


@dataclass(frozen=True, eq=False)
class MetThings:
    """Background, objects and fragments at an instant.

    Attributes:
        instances: background first, then the objects in their order, then fragments.
        attributes: what is known of their reflectivity.
        object_ids: of the objects.
    """

    instances: tuple[Instance, ...]
    attributes: tuple[Attributes | None, ...]
    object_ids: Sequence[str]


def met_things(world: World) -> MetThings:
    """What there is for rays to meet: with surfaces for LiDARs where the scene has them, objects
    deformed by impacts as images show them, and no shadows."""
    scene, agents = world.scene, world.agents
    shown_us = min(world.t_us, scene.end_us)
    found = [met_background(scene, world.state)]
    strides = world.strides.made
    for subject, transform in zip(agents.objects, agents.transforms, strict=True):
        stride = strides.get(subject.object_id)
        found.append(met_object(scene, subject, transform, shown_us, stride=stride))
    ids = [subject.object_id for subject in agents.objects]
    if world.deformation is not None:
        _deform(world, found, ids)
        fragments = world.deformation.fragments(world.t_us)
        found += [(fragment, None) for fragment in fragments]
    instances, attributes = zip(*found, strict=True)
    return MetThings(instances, attributes, ids)


def _deform(
    world: World, found: list[tuple[Instance, Attributes | None]], ids: Sequence[str]
) -> None:
    """Put deformed objects in the place of whole ones."""
    shapes = world.deformation
    assert shapes is not None
    if not shapes.has_impacts:
        return
    shown_us, strides = min(world.t_us, world.scene.end_us), world.strides.made
    drawn = compose(world.scene, world.state, world.agents, shown_us, strides=strides)
    for k, object_id in enumerate(ids, start=1):
        deformed = shapes.deformed_instance(object_id, drawn[k], world.t_us)
        if deformed is not drawn[k]:
            found[k] = (deformed, None)


def sweep_request(world: World, lidar: Lidar, things: MetThings) -> CastRequest:
    """The sweep that ends at the instant of ``world``."""
    offsets = lidar.beams.slots[0]
    times = world.t_us + offsets
    wake, agents = world.wake, world.agents
    ego = wake.ego_poses(times, t_us=world.t_us, now=world.T_world_body, twist=world.twist)
    still = not np.any(offsets)
    moved: list[Float | None] = [None] * len(things.instances)
    for k, object_id in enumerate(things.object_ids, start=1):
        if not still:
            moved[k] = wake.object_poses(object_id, times, t_us=world.t_us, now=agents)
    met = SweepScene(things.instances, tuple(moved), things.attributes, incidence_of(world.scene))
    return met.request(lidar, ego @ lidar.T_vehicle_lidar)
