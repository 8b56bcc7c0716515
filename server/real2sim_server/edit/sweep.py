"""From a state to what a LiDAR meets: objects where edits put them, moving over the sweep."""

from __future__ import annotations

from ..geometry.rotation import Float
from ..render.cast.recorded import Attributes, SweepScene, met_by_lidar, transforms_at
from ..render.types import Instance
from ..scene import GaussianCloud, Lidar, Scene
from .compose import without_regions
from .state import ObjectState, ScenarioState


def sweep_of(scene: Scene, state: ScenarioState, lidar: Lidar, t_us: int) -> SweepScene:
    """What ``lidar`` meets of a scenario in the sweep about ``t_us`` [us].

    Every visible object that exists then, moved, turned, inserted or scaled as the edits say, with
    its surfaces for LiDARs where the scene has them; the background without erased regions.

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    cloud, attributes = met_by_lidar(scene, None)
    if state.erased:
        cloud = without_regions(cloud, state.erased)
    instances, known = [Instance(cloud)], [attributes]
    moved: list[Float | None] = [None]
    placed = state.tracks.at(t_us)
    times = t_us + lidar.beams.slots[0]
    for subject, transform in zip(placed.objects, placed.transforms, strict=True):
        cloud, attributes = _met(scene, subject)
        instances.append(Instance(cloud, transform, subject.instance_id, subject.scale))
        moved.append(transforms_at(subject.trajectory, times))
        known.append(attributes)
    return SweepScene(tuple(instances), tuple(moved), tuple(known))


def _met(scene: Scene, subject: ObjectState) -> tuple[GaussianCloud, Attributes | None]:
    if subject.asset is not None:
        return subject.asset.cloud_in(scene), None
    return met_by_lidar(scene, subject.source_id)
