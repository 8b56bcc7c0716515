"""From a state to what the renderer draws."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch

from real2sim_proto.operations import EraseRegion
from real2sim_proto.semantics import semantic_class

from ..geometry.rotation import Float
from ..geometry.transform import invert_transform, transform_from
from ..render.types import Instance
from ..scene import Figure, GaussianCloud, Scene, Stride
from .ground_inpainting import inpaint_ground, vacated_parking
from .shadow import contact_shadow
from .state import ObjectState, ScenarioState
from .tracks import PlacedObjects

T = TypeVar("T")

NO_STRIDES: Mapping[str, Stride] = MappingProxyType({})
KEPT_BACKGROUNDS = 4
"""Backgrounds with erased regions that are kept for each scene; one costs 4 bytes a Gaussian, and
that of its colours too where parked objects were moved."""


def instances_at(scene: Scene, state: ScenarioState, t_us: int) -> list[Instance]:
    """Background first, then every visible object that exists at ``t_us``, then soft shadows under
    objects that an edit has put where they are; only what changes over time is computed.

    Args:
        scene: holds the Gaussians; it must be the one that ``state`` was made of.
        state: objects, poses and scales.
        t_us: instant [us].

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    return compose(scene, state, state.tracks.at(t_us), t_us)


def compose(
    scene: Scene,
    state: ScenarioState,
    placed: PlacedObjects[ObjectState],
    t_us: int,
    *,
    strides: Mapping[str, Stride] = NO_STRIDES,
) -> list[Instance]:
    """The same for objects that are ``placed`` already, wherever, people among them as far in
    walking as ``strides`` say by id, others as their trajectories lead them. Raises like
    :func:`instances_at`."""
    poses = {o.object_id: T for o, T in zip(placed.objects, placed.transforms, strict=True)}
    instances = [Instance(composed_background(scene, state, poses))]
    edited = []
    for subject, transform in zip(placed.objects, placed.transforms, strict=True):
        stride = strides.get(subject.object_id)
        instances.append(_standing(scene, subject, transform, t_us, stride=stride))
        if subject.edited:
            edited.append((subject, transform))
    return instances + contact_shadows(scene, edited, t_us)


def things_of(
    scene: Scene, state: ScenarioState, objects: Iterable[ObjectState]
) -> tuple[Instance, ...] | None:
    """The background and ``objects`` as :func:`compose` draws them, wherever they stand; None
    where edits make the background hang on where they do, or put shadows under them, or where
    somebody walks.

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    shown = tuple(objects)
    if any(figure_of(scene, subject) is not None for subject in shown):
        return None
    as_recorded = all(state.objects.get(name) is known for name, known in state.recorded.items())
    if state.erased or not as_recorded or any(subject.edited for subject in shown):
        return None
    return (Instance(scene.background), *_anywhere(scene, shown))


def things_at_start(scene: Scene, state: ScenarioState) -> list[Instance]:
    """Everything that is drawn of a scenario at its start or comes later, but shadows: the
    background and every visible object, wherever. Raises like :func:`things_of`."""
    placed = state.tracks.at(scene.start_us)
    poses = {o.object_id: T for o, T in zip(placed.objects, placed.transforms, strict=True)}
    background = Instance(composed_background(scene, state, poses))
    return [background, *_anywhere(scene, state.tracks.objects)]


def _anywhere(scene: Scene, objects: Iterable[ObjectState]) -> Iterable[Instance]:
    nowhere = transform_from(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    return (_standing(scene, subject, nowhere, scene.start_us) for subject in objects)


def _standing(
    scene: Scene, subject: ObjectState, transform: Float, t_us: int, *, stride: Stride | None = None
) -> Instance:
    placement = (transform, subject.instance_id, subject.scale)
    semantic = semantic_class(subject.category)
    cloud = _posed(scene, subject, t_us, stride)
    if subject.asset is not None:
        return Instance(cloud, *placement, semantic=semantic)
    colour = scene.object(subject.source_id).colour
    return Instance(cloud, *placement, colour=colour, t_us=t_us, semantic=semantic)


def contact_shadows(
    scene: Scene, placed: Iterable[tuple[ObjectState, Float]], t_us: int
) -> list[Instance]:
    """Soft shadows under the objects (each with its ``T_world_object``) that are not where the
    recording, and so their shadow in the background, has them at ``t_us``."""
    shadows = [
        contact_shadow(transform, subject.scaled_size, scene.ground, device=scene.background.device)
        for subject, transform in placed
        if not _as_recorded(scene, subject, transform, t_us)
    ]
    return [shadow for shadow in shadows if shadow is not None]


def cloud_of(
    scene: Scene, subject: ObjectState, t_us: int, *, stride: Stride | None = None
) -> GaussianCloud:
    """The Gaussians an object shows at ``t_us``, before its own scale, in its own frame; of a
    person as far in walking as ``stride`` says, or else as the trajectory leads.

    Raises:
        UnknownObjectError: ``subject`` is of another scene.
    """
    cloud = _posed(scene, subject, t_us, stride)
    if subject.asset is not None:
        return cloud
    colour = scene.object(subject.source_id).colour
    return cloud if colour is None else colour.at(cloud, t_us)


def _posed(scene: Scene, subject: ObjectState, t_us: int, stride: Stride | None) -> GaussianCloud:
    asset = subject.asset
    cloud = scene.object(subject.source_id).cloud if asset is None else asset.cloud_in(scene)
    figure = figure_of(scene, subject)
    if figure is None:
        return cloud
    if stride is not None:
        return figure.striding(cloud, stride)
    return figure.posed(cloud, subject.trajectory, t_us)


def figure_of(scene: Scene, subject: ObjectState) -> Figure | None:
    """The figure of an object that is a person who walks, as edits let it walk, else None.

    Raises:
        UnknownObjectError: ``subject`` is of another scene.
    """
    asset = subject.asset
    figure = asset.figure if asset is not None else scene.object(subject.source_id).figure
    if figure is None or subject.gait is None:
        return figure
    return figure.styled(**subject.gait.model_dump(exclude={"op", "object_id"}, exclude_none=True))


def composed_background(
    scene: Scene, state: ScenarioState, poses: Mapping[str, Float]
) -> GaussianCloud:
    """The background with all Gaussians in erased regions made invisible, and with plain ground
    where parked objects stood that ``poses`` (``T_world_object`` [4, 4] by id) have elsewhere; the
    rest is shared."""
    erased, left = state.erased, vacated_parking(state, poses)
    if not erased and not left:
        return scene.background

    def make() -> GaussianCloud:
        background = inpaint_ground(scene, scene.background, left) if left else scene.background
        return without_regions(background, erased) if erased else background

    return kept(scene, (erased, left), make)


def without_regions(background: GaussianCloud, erased: tuple[EraseRegion, ...]) -> GaussianCloud:
    """The background with the Gaussians whose centres lie in ``erased`` made invisible."""
    opacities = background.opacities.clone()
    for region in erased:
        T_region_world = invert_transform(
            transform_from(region.pose.position, region.pose.quaternion)
        )
        to_region = torch.from_numpy(T_region_world).to(background.means)
        local = background.means @ to_region[:3, :3].T + to_region[:3, 3]
        half = torch.tensor(region.size).to(background.means) / 2
        opacities[(local.abs() <= half).all(dim=1)] = 0.0
    return replace(background, opacities=opacities)


def _as_recorded(scene: Scene, subject: ObjectState, transform: Float, t_us: int) -> bool:
    if subject.asset is not None or subject.object_id != subject.source_id:
        return False
    recorded = scene.object(subject.source_id).trajectory
    if not recorded.covers(t_us):
        return False
    return bool(abs(recorded.transform(t_us) - transform).max() < 0.02)


_derived: WeakKeyDictionary[Scene, OrderedDict[Hashable, object]] = WeakKeyDictionary()
_deriving = threading.Lock()


def kept(scene: Scene, key: Hashable, make: Callable[[], T]) -> T:
    """What ``make`` made of ``scene`` before, or makes now."""
    with _deriving:
        made = _derived.setdefault(scene, OrderedDict())
        if key not in made:
            made[key] = make()
        made.move_to_end(key)
        while len(made) > KEPT_BACKGROUNDS:
            made.popitem(last=False)
        return made[key]  # type: ignore[return-value]
