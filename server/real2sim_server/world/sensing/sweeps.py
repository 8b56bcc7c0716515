"""From the echo of a LiDAR's rays to a cloud of points."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...edit import ScenarioState
from ...edit.sweep import sweep_of
from ...geometry.rotation import Float
from ...geometry.transform import invert_transform
from ...render.cast.detect import Sweep, detect
from ...render.cast.recorded import sensor_poses
from ...render.cast.types import CastBackend, CastRequest, Echo
from ...scene import Lidar, Scene
from ..ranging import Cloud, MountedLidar, in_frame
from ..world import World
from .met import MetThings, sweep_request

SEED_BYTES = 7


def sweep_cloud(
    world: World, mounted: MountedLidar, things: MetThings, caster: CastBackend
) -> Cloud:
    """The sweep of a LiDAR that ends at the instant of ``world``; the same bits again for the same
    episode."""
    return measured_sweep(
        sweep_request(world, mounted.lidar, things),
        mounted,
        caster,
        t_us=world.t_us,
        seed=sensor_seed(world, mounted.name),
        T_world_vehicle=world.T_world_body,
        T_world_told=world.T_world_estimate,
    )


def recorded_cloud(
    scene: Scene, state: ScenarioState, mounted: MountedLidar, t_us: int, caster: CastBackend
) -> Cloud:
    """The sweep of a LiDAR on the recording vehicle that ends at ``t_us``, all objects as edited.

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
        T_world_told=T_world_vehicle,
    )


def measured_sweep(
    request: CastRequest,
    mounted: MountedLidar,
    caster: CastBackend,
    *,
    t_us: int,
    seed: int,
    T_world_vehicle: Float,
    T_world_told: Float,
) -> Cloud:
    """What a LiDAR makes of the rays of a sweep.

    Args:
        request: of the sweep.
        mounted: the LiDAR.
        caster: follows the rays.
        t_us: when the last one is fired [us].
        seed: of noise and losses.
        T_world_vehicle: [4, 4], where the vehicle is then.
        T_world_told: [4, 4], where it takes itself to be.
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
        T_world_sensor=T_world_told @ lidar.T_vehicle_lidar,
        columns=columns,
        codec=spec.codec,
    )


def sensor_seed(world: World, name: str) -> int:
    """Of the noise of a sensor at an instant."""
    words = f"{world.spec.seed}/{name}/{world.steps}"
    digest = hashlib.blake2b(words.encode(), digest_size=SEED_BYTES).digest()
    return int.from_bytes(digest, "little")


def _returns(sweep: Sweep, echo: Echo, mounted: MountedLidar) -> dict[str, NDArray[Any]]:
    """Columns of all returns, ray by ray, near to far: rows of a turning sensor one by one."""
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
    """Row of each ray of a turning sensor; 0 of others."""
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
    """[N, 3] in the sensor's frame, of a compensated cloud in that of ``T_world_lidar``."""
    lidar, ray = mounted.lidar, returned["ray"]
    directions = lidar.beams.directions.reshape(-1, 3)[ray]
    points: Float = directions * returned["range"][:, None].astype(np.float64)
    if not mounted.spec.compensated:
        return points
    relative = invert_transform(T_world_lidar) @ request.T_world_lidar
    of_ray = relative[lidar.beams.slots[1].ravel()[ray]]
    turned: Float = np.einsum("nij,nj->ni", of_ray[:, :3, :3], points) + of_ray[:, :3, 3]
    return turned
