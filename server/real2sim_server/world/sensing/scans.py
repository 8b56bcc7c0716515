"""From the rays of a radar to a cloud of detections."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.semantics import GROUND, STATIC

from ...geometry.rotation import Float, quaternion_to_matrix
from ...render.cast.radar import Patches, radar_detections
from ...render.cast.types import CastBackend, CastRequest, Echo
from ...render.ground_class import TOLERANCE
from ...render.types import Instance
from ..ranging import Cloud, MountedRadar, in_frame
from ..world import World
from .met import MetThings, sweep_request
from .sweeps import sensor_seed


def scan_cloud(
    world: World, mounted: MountedRadar, things: MetThings, caster: CastBackend
) -> Cloud:
    """The scan of a radar at the instant of ``world``; the same bits again for the same episode."""
    radar, spec = mounted.radar, mounted.spec
    request = sweep_request(world, radar.rays, things)
    echo = caster.cast(request)
    patches = _patches(world, request, echo, things)
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


def _patches(world: World, request: CastRequest, echo: Echo, things: MetThings) -> Patches:
    lidar = request.lidar
    hit = echo.hit
    distance = echo.range[hit].astype(np.float64)
    directions = lidar.beams.directions[hit]
    T_world_sensor = request.T_world_lidar[-1]
    rays = directions @ T_world_sensor[:3, :3].T
    points = rays * distance[:, None] + T_world_sensor[:3, 3]
    owner, normals, semantic, centres, velocities = _owners(world, things, echo.member[hit])
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
    world: World, things: MetThings, members: NDArray[np.int32]
) -> tuple[NDArray[np.int64], Float, NDArray[np.uint8], Float, Float]:
    """Of each ray: the number of the instance that it meets, the normal there in the world, its
    class; and for each instance its centre and its velocity and turn [6] in the world."""
    counts = [len(instance.cloud) for instance in things.instances]
    firsts = np.cumsum([0, *counts])
    owner = np.searchsorted(firsts, members, side="right") - 1
    normals = np.zeros((len(members), 3))
    centres, velocities = np.zeros((len(counts), 3)), np.zeros((len(counts), 6))
    semantic = np.zeros(len(members), np.uint8)
    for k, instance in enumerate(things.instances):
        own = owner == k
        pose = instance.T_world_object
        if pose is not None:
            centres[k] = np.asarray(pose)[:3, 3]
        if own.any():
            normals[own] = _normals(instance, members[own] - firsts[k])
            semantic[own] = instance.semantic
    velocities[1 : len(things.object_ids) + 1, :3] = world.agents.velocities
    velocities[1 : len(things.object_ids) + 1, 5] = _turns(world, things.object_ids)
    return owner, normals, semantic, centres, velocities


def _normals(instance: Instance, members: NDArray[np.int32]) -> Float:
    """Shortest axes [P, 3] in the world of Gaussians."""
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
    if not world.wake.ways:
        return rates
    for k, object_id in enumerate(object_ids):
        before, after = world.wake.object_poses(object_id, times, t_us=world.t_us, now=world.agents)
        turn = after[:3, :3] @ before[:3, :3].T
        rates[k] = np.arctan2(turn[1, 0], turn[0, 0]) / (step * 1e-6)
    return rates


def _at(velocities: Float, owner: NDArray[np.int64], centres: Float, points: Float) -> Float:
    """Velocity [P, 3] in the world of the points that rays meet."""
    arms = points - centres[owner]
    own = velocities[owner]
    moving: Float = own[:, :3] + np.cross(own[:, 3:], arms)
    return moving


def _of_sensor(world: World, T_world_sensor: Float) -> Float:
    """Velocity [3] of the sensor in the world."""
    twist = world.twist
    arm = T_world_sensor[:3, 3] - world.T_world_body[:3, 3]
    moving: Float = twist[:3] + np.cross(twist[3:], arm)
    return moving
