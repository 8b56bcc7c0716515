"""Converts a scenario state to instances for the renderer and targets for LiDARs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from real2sim_proto.base import Pose
from real2sim_proto.conventions import GROUND, STATIC, semantic_class
from real2sim_proto.drive import Lamp
from real2sim_proto.operations import EraseRegion

from ..geometry import Float, invert_transform, quaternion_to_matrix, transform_from
from ..render.cast.call import Attributes, SweepScene, incidence_of, lidar_target, transforms_at
from ..render.lens import TOLERANCE
from ..render.types import Instance
from ..scene import Figure, GaussianCloud, Lidar, Scene, Stride, Trajectory
from ..scene.cloud import SH_C0
from .appearance import (
    inpaint_ground,
    lamp_cloud,
    off_track,
    vacated_parking,
    without_shadows,
)
from .light import Recent, cast_shadow, shaded
from .motion import require_object
from .state import ObjectState, ScenarioState
from .tracks import PlacedObjects

NO_STRIDES: Mapping[str, Stride] = MappingProxyType({})
KEPT_BACKGROUNDS = 4
"""Number of cached backgrounds with erased regions per scene; each costs 4 bytes per Gaussian, and
its colours as well if parked objects were moved.
"""


def instances_at(scene: Scene, state: ScenarioState, t_us: int) -> list[Instance]:
    """The background, every visible object at ``t_us``, and shadows, in this order.

    Edited objects get shadows and the light of their place. Parts that do not depend on time are
    cached.

    Args:
        scene: scene with the Gaussians; ``state`` must be made from it.
        state: objects, poses and scales.
        t_us: time [us].

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
    """Like :func:`instances_at`, for objects that are already ``placed``.

    People walk by their ``strides`` (by id), or otherwise by their trajectories. Raises the same
    errors.
    """
    poses = {o.object_id: T for o, T in zip(placed.objects, placed.transforms, strict=True)}
    instances = [Instance(composed_background(scene, state, poses))]
    edited = []
    for subject, transform in zip(placed.objects, placed.transforms, strict=True):
        stride = strides.get(subject.object_id)
        instances.append(_standing(scene, subject, transform, t_us, stride=stride))
        if subject.edited:
            edited.append((subject, transform))
    return instances + cast_shadows(scene, edited, t_us)


def instances_of(
    scene: Scene, state: ScenarioState, objects: Iterable[ObjectState]
) -> tuple[Instance, ...] | None:
    """The background and ``objects`` as :func:`compose` renders them, independent of their poses.

    None if the background depends on the poses because of edits, if edits add shadows, or if a
    person walks.

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    shown = tuple(objects)
    if any(figure_of(scene, subject) is not None for subject in shown):
        return None
    as_recorded = all(state.objects.get(name) is known for name, known in state.recorded.items())
    if state.erased or not as_recorded or any(subject.edited for subject in shown):
        return None
    return (Instance(scene.background), *_anywhere(scene, shown, {}))


def instances_at_start(scene: Scene, state: ScenarioState) -> list[Instance]:
    """All instances that a scenario may render from its start on, except shadows: the background
    and every visible object, at any pose. Raises like :func:`instances_of`.
    """
    placed = state.tracks.at(scene.start_us)
    poses = {o.object_id: T for o, T in zip(placed.objects, placed.transforms, strict=True)}
    background = Instance(composed_background(scene, state, poses))
    return [background, *_anywhere(scene, state.tracks.objects, poses)]


def _anywhere(
    scene: Scene, objects: Iterable[ObjectState], poses: Mapping[str, Float]
) -> Iterable[Instance]:
    """Objects in the light of their ``poses``, or as recorded without one."""
    return (
        _standing(scene, subject, poses.get(subject.object_id), scene.start_us)
        for subject in objects
    )


def _standing(
    scene: Scene,
    subject: ObjectState,
    transform: Float | None,
    t_us: int,
    *,
    stride: Stride | None = None,
) -> Instance:
    placed = np.eye(4) if transform is None else transform
    placement = (placed, subject.instance_id, subject.scale)
    semantic = semantic_class(subject.category)
    cloud = _posed(scene, subject, t_us, stride)
    if subject.asset is not None:
        return Instance(cloud, *placement, semantic=semantic)
    recorded = scene.object(subject.source_id)
    colour = recorded.colour
    light_map = scene.light_map if subject.edited and cloud is recorded.cloud else None
    if light_map is not None and transform is not None:
        cloud, colour = shaded(recorded, transform, t_us, light_map)
    return Instance(cloud, *placement, colour=colour, t_us=t_us, semantic=semantic)


def lamps_on(
    scene: Scene, subject: ObjectState, shown: Instance, lamps: tuple[Lamp, ...]
) -> Instance:
    """The light of the lit ``lamps`` of an object that is drawn as ``shown``.

    Raises:
        UnknownObjectError: ``subject`` is of another scene.
    """
    light = lamp_cloud(_body(scene, subject), subject.scale, subject.scaled_size, lamps)
    return replace(shown, cloud=light, scale=(1.0, 1.0, 1.0), covars=None, colour=None)


def cast_shadows(
    scene: Scene, placed: Iterable[tuple[ObjectState, Float]], t_us: int
) -> list[Instance]:
    """Shadows of objects, given with their ``T_world_object``.

    Objects at their recorded pose at ``t_us`` are omitted: their shadow is in the background.
    """
    shadows = [
        cast_shadow(
            transform,
            _body(scene, subject),
            subject.scale,
            subject.scaled_size,
            scene.ground,
            light_map=scene.light_map,
        )
        for subject, transform in placed
        if not _as_recorded(scene, subject, transform, t_us)
    ]
    return [shadow for shadow in shadows if shadow is not None]


def cloud_of(
    scene: Scene, subject: ObjectState, t_us: int, *, stride: Stride | None = None
) -> GaussianCloud:
    """The Gaussians of an object at ``t_us``, in the object's frame, before its scale is applied.

    A person walks by ``stride``, or otherwise by the trajectory.

    Raises:
        UnknownObjectError: ``subject`` is of another scene.
    """
    cloud = _posed(scene, subject, t_us, stride)
    if subject.asset is not None:
        return cloud
    colour = scene.object(subject.source_id).colour
    return cloud if colour is None else colour.at(cloud, t_us)


def _body(scene: Scene, subject: ObjectState) -> GaussianCloud:
    asset = subject.asset
    return scene.object(subject.source_id).cloud if asset is None else asset.cloud_in(scene)


def _posed(scene: Scene, subject: ObjectState, t_us: int, stride: Stride | None) -> GaussianCloud:
    cloud = _body(scene, subject)
    figure = figure_of(scene, subject)
    if figure is None:
        return cloud
    if stride is not None:
        return figure.striding(cloud, stride)
    return figure.posed(cloud, subject.trajectory, t_us)


def figure_of(scene: Scene, subject: ObjectState) -> Figure | None:
    """The figure of a walking person, with edits applied; None for other objects.

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
    """The background without erased regions, with inpainted ground where parked objects were, and
    without the recorded shadows of objects that are elsewhere.

    ``poses`` are ``T_world_object`` [4, 4] by id; parked objects that they move uncover the ground.
    All other tensors are shared.
    """
    erased, left = state.erased, vacated_parking(state, poses)
    moved = off_track(state) if scene.sunlight is not None else ()
    if not erased and not left and not moved:
        return scene.background

    def make() -> GaussianCloud:
        background = without_shadows(scene, scene.background, left + moved)
        background = inpaint_ground(scene, background, left) if left else background
        return without_regions(background, erased) if erased else background

    return _backgrounds.get(scene, (erased, left, moved), make)


def without_regions(background: GaussianCloud, erased: tuple[EraseRegion, ...]) -> GaussianCloud:
    """The background with all Gaussians invisible whose centres are in ``erased``."""
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


_backgrounds: Recent[Scene, GaussianCloud] = Recent(KEPT_BACKGROUNDS)


# --- Free poses ----------------------------------------------------------------------------------

# A scene with objects at the poses of a request, without an edit.

Others = Literal["recorded", "parked", "none"]


def posed_instances(
    scene: Scene, t_us: int, poses: Mapping[str, Pose], *, others: Others = "recorded"
) -> list[Instance]:
    """Instances at a time with objects at ``poses``, as for :func:`instances_at`.

    Args:
        scene: without edits.
        t_us: time for the other objects and for colours [us].
        poses: ``T_world_object`` by id.
        others: treatment of objects without a pose: all as recorded, only parked ones, or none.

    Raises:
        EditError: UNKNOWN_OBJECT, for an object that the scene lacks.
    """
    state = ScenarioState.of(scene)
    for object_id in poses:
        require_object(state, object_id)
    objects = {
        object_id: _placed(subject, poses[object_id], t_us)
        if object_id in poses
        else replace(subject, deleted=not _shown(subject, others))
        if others != "recorded"
        else subject
        for object_id, subject in state.objects.items()
    }
    return instances_at(scene, replace(state, objects=MappingProxyType(objects)), t_us)


def _placed(subject: ObjectState, pose: Pose, t_us: int) -> ObjectState:
    there = Trajectory(
        times_us=np.array([t_us], dtype=np.int64),
        positions=np.array([pose.position]),
        quaternions=np.array([pose.quaternion]),
    )
    return replace(subject, trajectory=there, edited=True)


def _shown(subject: ObjectState, others: Others) -> bool:
    return others == "parked" and not subject.trajectory.moves


# --- LiDAR sweeps --------------------------------------------------------------------------------

# Objects at their edited poses, moving during the sweep.


def sweep_of(scene: Scene, state: ScenarioState, lidar: Lidar, t_us: int) -> SweepScene:
    """Targets of ``lidar`` in a scenario during the sweep about ``t_us`` [us].

    Contains the background without erased regions, and every visible object that exists then, with
    its edits, and with fitted LiDAR surfaces if the scene has them.

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    placed = state.tracks.at(t_us)
    times = t_us + lidar.beams.slots[0]
    moved = [transforms_at(subject.trajectory, times) for subject in placed.objects]
    instances, known = zip(*targets_at(scene, state, placed, t_us), strict=True)
    return SweepScene(instances, (None, *moved), known, incidence_of(scene))


def targets_at(
    scene: Scene,
    state: ScenarioState,
    placed: PlacedObjects[ObjectState],
    t_us: int,
    *,
    strides: Mapping[str, Stride] = NO_STRIDES,
) -> list[tuple[Instance, Attributes | None]]:
    """Geometry for ray casting: the background without erased regions, then the objects in order;
    each with its attributes. Fitted LiDAR surfaces replace Gaussians where the scene has them; the
    rest has no attributes.

    Args:
        placed: objects and their poses.
        t_us: time of the scene [us].
        strides: gait of walking people by id; the others have that of ``t_us``.
    """
    cloud, attributes = lidar_target(scene, None)
    if state.erased:
        key = ("lidar", state.erased)
        cloud = _backgrounds.get(scene, key, lambda: without_regions(cloud, state.erased))
    found = [(Instance(cloud), attributes)]
    for subject, transform in zip(placed.objects, placed.transforms, strict=True):
        own, known = _object_cloud(scene, subject, t_us, strides.get(subject.object_id))
        semantic = semantic_class(subject.category)
        drawn = Instance(own, transform, subject.instance_id, subject.scale, semantic=semantic)
        found.append((drawn, known))
    return found


def _object_cloud(
    scene: Scene, subject: ObjectState, t_us: int, stride: Stride | None
) -> tuple[GaussianCloud, Attributes | None]:
    if subject.asset is not None or figure_of(scene, subject) is not None:
        return cloud_of(scene, subject, t_us, stride=stride), None
    return lidar_target(scene, subject.source_id)


# --- Points --------------------------------------------------------------------------------------

# The centres of Gaussians at an instant, with colour and normal.

Part = Literal["all", "background", "objects"]

ROW = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue", "semantic")),
        ("instance", "<u2"),
    ]
)
"""A point in the world [m]; its normal is the thinnest axis of its Gaussian."""

MIN_OPACITY = 0.1
"""Minimum opacity of exported Gaussians."""

_TYPES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort"}


def points_at(
    scene: Scene,
    state: ScenarioState,
    t_us: int,
    *,
    part: Part = "all",
    instance_id: int | None = None,
    min_opacity: float = MIN_OPACITY,
) -> NDArray[np.void]:
    """Points of a scenario at a time, as an array of dtype ROW.

    Normals of the background point towards the recorded path, normals of objects away from the
    object's centre.

    Args:
        scene: scene of the scenario.
        state: the scenario.
        t_us: time [us].
        part: part of the scene.
        instance_id: id of a single object; None for all.
        min_opacity: minimum opacity of a Gaussian.

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    shown = instances_at(scene, state, t_us)
    background, objects = shown[0], [i for i in shown[1:] if i.instance_id > 0]
    if instance_id is not None:
        objects = [i for i in objects if i.instance_id == instance_id]
    kept = [background] if part != "objects" and instance_id is None else []
    kept += objects if part != "background" else []
    rows = [_rows(scene, instance, min_opacity) for instance in kept]
    return np.concatenate(rows) if rows else np.zeros(0, ROW)


def ply_of_points(rows: NDArray[np.void]) -> Iterable[bytes]:
    """A binary ply file, in parts."""
    names = rows.dtype.names or ()
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {_TYPES[rows.dtype[name].str]} {name}" for name in names]
    yield ("\n".join([*lines, "end_header"]) + "\n").encode()
    yield rows.tobytes()


def _rows(scene: Scene, instance: Instance, min_opacity: float) -> NDArray[np.void]:
    cloud = instance.cloud
    if instance.colour is not None:
        cloud = instance.colour.at(cloud, instance.t_us)
    seen = (cloud.opacities >= min_opacity).cpu().numpy()
    means = cloud.means.cpu().numpy()[seen].astype(np.float64)
    scale = np.asarray(instance.scale)
    scales = cloud.scales.cpu().numpy()[seen] * scale
    turns = quaternion_to_matrix(cloud.quats.cpu().numpy()[seen].astype(np.float64))
    thin = np.take_along_axis(turns, scales.argmin(axis=1)[:, None, None], axis=2)[..., 0]
    points = means * scale
    placed = instance.T_world_object
    towards = _nearest(scene.ego.positions, points) if placed is None else 2 * points
    outward = towards - points
    thin[(thin * outward).sum(axis=1) < 0] *= -1
    if placed is not None:
        pose = np.asarray(placed, dtype=np.float64)
        points, thin = points @ pose[:3, :3].T + pose[:3, 3], thin @ pose[:3, :3].T
    rows = np.zeros(len(points), ROW)
    for k, axis in enumerate("xyz"):
        rows[axis], rows[f"n{axis}"] = points[:, k], thin[:, k]
    colours = np.clip(cloud.sh.cpu().numpy()[seen, 0] * SH_C0 + 0.5, 0, 1)
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = np.rint(colours[:, k] * 255)
    rows["instance"], rows["semantic"] = instance.instance_id, instance.semantic
    if instance.instance_id == 0:
        above = np.abs(points[:, 2] - scene.ground.height_at(points[:, :2]))
        rows["semantic"] = np.where(above < TOLERANCE, GROUND, STATIC)
    return rows


def _nearest(path: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest point of a path, raised to the height of the sensors, for each point."""
    from scipy.spatial import cKDTree

    raised = path + np.array([0.0, 0.0, 1.6])
    found: NDArray[np.float64] = raised[cKDTree(raised).query(points)[1]]
    return found
