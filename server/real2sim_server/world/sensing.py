"""LiDAR and radar measurements in a world: ray targets and point clouds."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.conventions import GROUND, STATIC

from ..edit import ScenarioState
from ..edit.compose import compose, sweep_of, targets_at
from ..geometry import Float, invert_transform, quaternion_to_matrix
from ..render.cast.call import Attributes, SweepScene, incidence_of, sensor_poses
from ..render.cast.sensors import Patches, Sweep, detect, radar_detections
from ..render.cast.types import CastBackend, CastRequest, Echo
from ..render.lens import TOLERANCE
from ..render.types import Instance
from ..scene import Lidar, Scene
from .ranging import Cloud, Mounted, MountedLidar, MountedRadar, in_frame
from .world import World


@dataclass(frozen=True, eq=False)
class RayTargets:
    """Targets of rays at an instant: background, objects and fragments.

    Attributes:
        instances: background first, then the objects in their order, then fragments.
        attributes: reflectivity, if known.
        object_ids: ids of the objects.
    """

    instances: tuple[Instance, ...]
    attributes: tuple[Attributes | None, ...]
    object_ids: Sequence[str]


def ray_targets(world: World) -> RayTargets:
    """The ray targets of a world.

    LiDAR surfaces replace splats if the scene has them. Objects deformed by impacts look as in
    images. Shadows are omitted.
    """
    scene, agents, strides = world.scene, world.agents, world.strides.made
    shown_us = min(world.t_us, scene.end_us)
    found = targets_at(scene, world.state, agents, shown_us, strides=strides)
    ids = [subject.object_id for subject in agents.objects]
    if world.deformation is not None:
        _deform(world, found, ids)
        fragments = world.deformation.fragments(world.t_us)
        found += [(fragment, None) for fragment in fragments]
    instances, attributes = zip(*found, strict=True)
    return RayTargets(instances, attributes, ids)


def _deform(
    world: World, found: list[tuple[Instance, Attributes | None]], ids: Sequence[str]
) -> None:
    """Replace intact objects with deformed ones."""
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


def sweep_request(world: World, lidar: Lidar, targets: RayTargets) -> CastRequest:
    """The ray casting request of the sweep that ends at the instant of ``world``."""
    offsets = lidar.beams.slots[0]
    times = world.t_us + offsets
    history, agents = world.motion_history, world.agents
    ego = history.ego_poses(times, t_us=world.t_us, now=world.T_world_body, twist=world.twist)
    still = not np.any(offsets)
    moved: list[Float | None] = [None] * len(targets.instances)
    for k, object_id in enumerate(targets.object_ids, start=1):
        if not still:
            moved[k] = history.object_poses(object_id, times, t_us=world.t_us, now=agents)
    met = SweepScene(targets.instances, tuple(moved), targets.attributes, incidence_of(world.scene))
    return met.request(lidar, ego @ lidar.T_vehicle_lidar)


SEED_BYTES = 7


def sweep_cloud(
    world: World, mounted: MountedLidar, targets: RayTargets, caster: CastBackend
) -> Cloud:
    """The LiDAR sweep that ends at the instant of ``world``; bitwise deterministic."""
    return measured_sweep(
        sweep_request(world, mounted.lidar, targets),
        mounted,
        caster,
        t_us=world.t_us,
        seed=sensor_seed(world, mounted.name),
        T_world_vehicle=world.T_world_body,
        T_world_estimate=world.T_world_estimate,
    )


def recorded_cloud(
    scene: Scene, state: ScenarioState, mounted: MountedLidar, t_us: int, caster: CastBackend
) -> Cloud:
    """The sweep of a LiDAR on the recording vehicle that ends at ``t_us``, with edits applied.

    Raises:
        TimeOutOfRangeError: ``t_us`` is outside the recording.
    """
    lidar = mounted.lidar
    T_world_vehicle = scene.ego.transform(t_us)
    met = sweep_of(scene, state, lidar, t_us)
    return measured_sweep(
        met.request(lidar, sensor_poses(scene.ego, lidar, t_us)),
        mounted,
        caster,
        t_us=t_us,
        seed=0,
        T_world_vehicle=T_world_vehicle,
        T_world_estimate=T_world_vehicle,
    )


def measured_sweep(
    request: CastRequest,
    mounted: MountedLidar,
    caster: CastBackend,
    *,
    t_us: int,
    seed: int,
    T_world_vehicle: Float,
    T_world_estimate: Float,
) -> Cloud:
    """The point cloud that a LiDAR measures in a sweep.

    Args:
        request: ray casting request of the sweep.
        mounted: the LiDAR.
        caster: ray casting backend.
        t_us: time of the last ray [us].
        seed: seed of noise and dropped returns.
        T_world_vehicle: [4, 4], true vehicle pose at ``t_us``.
        T_world_estimate: [4, 4], estimated vehicle pose at ``t_us``.
    """
    spec, lidar = mounted.spec, mounted.lidar
    echo = caster.cast(request)
    returned = _returns(detect(echo, lidar, seed=seed), echo, mounted)
    T_world_lidar = T_world_vehicle @ lidar.T_vehicle_lidar
    points = _points(returned, request, mounted, T_world_lidar)
    columns: dict[str, NDArray[Any]] = {
        "points": in_frame(points, spec.frame, lidar.T_vehicle_lidar)
    }
    columns |= {name: returned[name] for name in spec.fields}
    return Cloud(
        sensor=mounted.name,
        modality="lidar",
        t_us=t_us,
        duration_us=mounted.duration_us,
        frame=spec.frame,
        compensated=spec.compensated,
        T_vehicle_sensor=lidar.T_vehicle_lidar,
        T_world_sensor=T_world_estimate @ lidar.T_vehicle_lidar,
        columns=columns,
        codec=spec.codec,
    )


def sensor_seed(world: World, name: str) -> int:
    """Noise seed of a sensor at the current instant."""
    words = f"{world.spec.seed}/{name}/{world.steps}"
    digest = hashlib.blake2b(words.encode(), digest_size=SEED_BYTES).digest()
    return int.from_bytes(digest, "little")


def _returns(sweep: Sweep, echo: Echo, mounted: MountedLidar) -> dict[str, NDArray[Any]]:
    """Columns of all returns, by ray, near to far; by row for a spinning sensor."""
    lidar = mounted.lidar
    hit = np.flatnonzero(sweep.hit.ravel())
    names = tuple(sweep.returns)
    if names:
        ranges = np.stack([sweep.returns[name].ravel()[hit] for name in names])
        shown = np.stack([echo.returns[name].intensity.ravel()[hit] for name in names])
    else:
        ranges, shown = sweep.range.ravel()[hit][None], sweep.intensity.ravel()[hit][None]
    order = np.argsort(ranges, axis=0, kind="stable")
    ranges, shown = (np.take_along_axis(a, order, axis=0) for a in (ranges, shown))
    apart = np.ones(ranges.shape, bool)
    apart[1:] = np.diff(ranges, axis=0) > 0
    apart &= (ranges >= lidar.min_range) & (ranges <= lidar.max_range)
    number = np.cumsum(apart, axis=0)
    ray, which = np.nonzero(apart.T)
    met = hit[ray]
    return {
        "range": ranges[which, ray],
        "ray": met,
        "intensity": np.clip(shown[which, ray], 0, 1).astype(np.float32),
        "ring": _rings(lidar)[met],
        "time_us": np.round(lidar.beams.time_us.ravel()[met]).astype(np.int32),
        "return_number": number[which, ray].astype(np.uint8),
        "instance": sweep.instance.ravel()[met],
    }


def _rings(lidar: Lidar) -> NDArray[np.uint16]:
    """Row of each ray of a spinning sensor; 0 for other sensors."""
    rings = np.zeros(lidar.shape, np.uint16)
    if len(lidar.shape) > 1:
        rings[:] = np.arange(lidar.shape[0])[:, None]
    return rings.ravel()


def _points(
    returned: Mapping[str, NDArray[Any]],
    request: CastRequest,
    mounted: MountedLidar,
    T_world_lidar: Float,
) -> Float:
    """Points [N, 3] in the sensor frame; at ``T_world_lidar`` if motion-compensated."""
    lidar, ray = mounted.lidar, returned["ray"]
    directions = lidar.beams.directions.reshape(-1, 3)[ray]
    points: Float = directions * returned["range"][:, None].astype(np.float64)
    if not mounted.spec.compensated:
        return points
    relative = invert_transform(T_world_lidar) @ request.T_world_lidar
    of_ray = relative[lidar.beams.slots[1].ravel()[ray]]
    turned: Float = np.einsum("nij,nj->ni", of_ray[:, :3, :3], points) + of_ray[:, :3, 3]
    return turned


def scan_cloud(
    world: World, mounted: MountedRadar, targets: RayTargets, caster: CastBackend
) -> Cloud:
    """The radar scan at the instant of ``world``; bitwise deterministic."""
    radar, spec = mounted.radar, mounted.spec
    request = sweep_request(world, radar.rays, targets)
    echo = caster.cast(request)
    patches = _patches(world, request, echo, targets)
    found = radar_detections(patches, radar, seed=sensor_seed(world, mounted.name))
    columns: dict[str, NDArray[Any]] = {
        "points": in_frame(found.points, spec.frame, radar.T_vehicle_radar)
    }
    for name in ("range", "azimuth", "elevation", "velocity", "rcs", "snr"):
        columns[name] = getattr(found, name).astype(np.float32)
    columns |= {"instance": found.instance, "kind": found.kind}
    return Cloud(
        sensor=mounted.name,
        modality="radar",
        t_us=world.t_us,
        duration_us=0,
        frame=spec.frame,
        compensated=True,
        T_vehicle_sensor=radar.T_vehicle_radar,
        T_world_sensor=world.T_world_estimate @ radar.T_vehicle_radar,
        columns=columns,
        codec=spec.codec,
    )


def _patches(world: World, request: CastRequest, echo: Echo, targets: RayTargets) -> Patches:
    lidar = request.lidar
    hit = echo.hit
    distance = echo.range[hit].astype(np.float64)
    directions = lidar.beams.directions[hit]
    T_world_sensor = request.T_world_lidar[-1]
    rays = directions @ T_world_sensor[:3, :3].T
    points = rays * distance[:, None] + T_world_sensor[:3, 3]
    owner, normals, semantic, centres, velocities = _owners(world, targets, echo.member[hit])
    on_ground = np.abs(points[:, 2] - world.ground.height_at(points[:, :2])) < TOLERANCE
    semantic = np.where((semantic == STATIC) & on_ground, GROUND, semantic).astype(np.uint8)
    cosine = np.abs(np.einsum("ni,ni->n", normals, rays))
    moving = _at(velocities, owner, centres, points) - _of_sensor(world, T_world_sensor)
    return Patches(
        range=distance,
        azimuth=lidar.beams.azimuth[hit],
        elevation=lidar.beams.elevation[hit],
        velocity=np.einsum("ni,ni->n", moving, rays),
        incidence=np.arccos(np.clip(cosine, 0, 1)),
        semantic=semantic,
        instance=echo.instance[hit],
    )


def _owners(
    world: World, targets: RayTargets, members: NDArray[np.int32]
) -> tuple[NDArray[np.int64], Float, NDArray[np.uint8], Float, Float]:
    """For each ray, the index of the hit instance, its class and the world normal there.

    Also the centre and twist [6] of each instance, world frame.
    """
    counts = [len(instance.cloud) for instance in targets.instances]
    firsts = np.cumsum([0, *counts])
    owner = np.searchsorted(firsts, members, side="right") - 1
    normals = np.zeros((len(members), 3))
    centres, velocities = np.zeros((len(counts), 3)), np.zeros((len(counts), 6))
    semantic = np.zeros(len(members), np.uint8)
    for k, instance in enumerate(targets.instances):
        own = owner == k
        pose = instance.T_world_object
        if pose is not None:
            centres[k] = np.asarray(pose)[:3, 3]
        if own.any():
            normals[own] = _normals(instance, members[own] - firsts[k])
            semantic[own] = instance.semantic
    velocities[1 : len(targets.object_ids) + 1, :3] = world.agents.velocities
    velocities[1 : len(targets.object_ids) + 1, 5] = _turns(world, targets.object_ids)
    return owner, normals, semantic, centres, velocities


def _normals(instance: Instance, members: NDArray[np.int32]) -> Float:
    """Shortest axes [P, 3] of Gaussians, world frame."""
    cloud = instance.cloud
    scales = cloud.scales.detach().cpu().numpy()[members]
    quats = cloud.quats.detach().cpu().numpy()[members].astype(np.float64)
    turns = quaternion_to_matrix(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    axes = turns[np.arange(len(members)), :, np.argmin(scales, axis=1)]
    if instance.T_world_object is None:
        return axes
    turned: Float = axes @ np.asarray(instance.T_world_object, dtype=np.float64)[:3, :3].T
    return turned


def _turns(world: World, object_ids: Any) -> Float:
    """Yaw rates [K] of objects over the last step [rad/s]."""
    step = world.spec.dt_us
    times = np.array([world.t_us - step, world.t_us], np.float64)
    rates = np.zeros(len(object_ids))
    if not world.motion_history.segments:
        return rates
    for k, object_id in enumerate(object_ids):
        before, after = world.motion_history.object_poses(
            object_id, times, t_us=world.t_us, now=world.agents
        )
        turn = after[:3, :3] @ before[:3, :3].T
        rates[k] = np.arctan2(turn[1, 0], turn[0, 0]) / (step * 1e-6)
    return rates


def _at(velocities: Float, owner: NDArray[np.int64], centres: Float, points: Float) -> Float:
    """Velocities [P, 3] of hit points, world frame."""
    arms = points - centres[owner]
    own = velocities[owner]
    moving: Float = own[:, :3] + np.cross(own[:, 3:], arms)
    return moving


def _of_sensor(world: World, T_world_sensor: Float) -> Float:
    """Sensor velocity [3], world frame."""
    twist = world.twist
    arm = T_world_sensor[:3, 3] - world.T_world_body[:3, 3]
    moving: Float = twist[:3] + np.cross(twist[3:], arm)
    return moving


def clouds_of(world: World, due: Sequence[Mounted], caster: CastBackend) -> list[Cloud]:
    """Point clouds of the ``due`` sensors at the instant of ``world``, in order."""
    targets = ray_targets(world)
    return [
        sweep_cloud(world, mounted, targets, caster)
        if isinstance(mounted, MountedLidar)
        else scan_cloud(world, mounted, targets, caster)
        for mounted in due
    ]
