"""From a state to what a LiDAR meets: objects where edits put them, moving over the sweep."""

from __future__ import annotations

from real2sim_proto.semantics import semantic_class

from ..geometry.rotation import Float
from ..render.cast.call import Attributes, SweepScene, incidence_of, met_by_lidar, transforms_at
from ..render.types import Instance
from ..scene import GaussianCloud, Lidar, Scene, Stride
from .compose import cloud_of, figure_of, kept, without_regions
from .state import ObjectState, ScenarioState


def sweep_of(scene: Scene, state: ScenarioState, lidar: Lidar, t_us: int) -> SweepScene:
    """What ``lidar`` meets of a scenario in the sweep about ``t_us`` [us].

    Every visible object that exists then, moved, turned, inserted or scaled as the edits say, with
    its surfaces for LiDARs where the scene has them; the background without erased regions.

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    placed = state.tracks.at(t_us)
    times = t_us + lidar.beams.slots[0]
    found = [met_background(scene, state)]
    moved: list[Float | None] = [None]
    for subject, transform in zip(placed.objects, placed.transforms, strict=True):
        found.append(met_object(scene, subject, transform, t_us))
        moved.append(transforms_at(subject.trajectory, times))
    instances, known = zip(*found, strict=True)
    return SweepScene(instances, tuple(moved), known, incidence_of(scene))


def met_background(scene: Scene, state: ScenarioState) -> tuple[Instance, Attributes | None]:
    """What rays meet of the background, without erased regions, and its attributes."""
    cloud, attributes = met_by_lidar(scene, None)
    if state.erased:
        cloud = kept(scene, ("lidar", state.erased), lambda: without_regions(cloud, state.erased))
    return Instance(cloud), attributes


def met_object(
    scene: Scene, subject: ObjectState, transform: Float, t_us: int, *, stride: Stride | None = None
) -> tuple[Instance, Attributes | None]:
    """What rays meet of an object at ``transform``, in its pose of ``t_us`` or, of a person, as far
    in walking as ``stride`` says, and its attributes."""
    cloud, attributes = _met(scene, subject, t_us, stride)
    semantic = semantic_class(subject.category)
    instance = Instance(cloud, transform, subject.instance_id, subject.scale, semantic=semantic)
    return instance, attributes


def _met(
    scene: Scene, subject: ObjectState, t_us: int, stride: Stride | None
) -> tuple[GaussianCloud, Attributes | None]:
    if subject.asset is not None or figure_of(scene, subject) is not None:
        return cloud_of(scene, subject, t_us, stride=stride), None
    return met_by_lidar(scene, subject.source_id)
