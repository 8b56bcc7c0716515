"""From a state to what the renderer draws."""

from __future__ import annotations

from ..render.types import Instance
from ..scene import Scene
from .state import ObjectState, ScenarioState
from .tracks import Placed


def instances_at(scene: Scene, state: ScenarioState, t_us: int) -> list[Instance]:
    """Background first, then every visible object that exists at ``t_us``; only colours that
    change over time are computed.

    Args:
        scene: holds the Gaussians; it must be the one that ``state`` was made of.
        state: objects, poses and scales.
        t_us: instant [us].

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    return compose(scene, state.tracks.at(t_us), t_us)


def compose(scene: Scene, placed: Placed[ObjectState], t_us: int) -> list[Instance]:
    """The same for objects already looked up. Raises like :func:`instances_at`."""
    instances = [Instance(scene.background)]
    for subject, transform in zip(placed.objects, placed.transforms, strict=True):
        cloud = scene.object(subject.source_id).cloud_at(t_us)
        instances.append(Instance(cloud, transform, subject.instance_id, subject.scale))
    return instances
