"""From the echo of a LiDAR's rays to a cloud of points."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...geometry.transform import invert_transform
from ...render.cast.detect import Sweep, detect
from ...render.cast.types import CastBackend, CastRequest, Echo
from ...scene import Lidar
from ..ranging import Cloud, MountedLidar, in_frame
from ..world import World
from .met import MetThings, sweep_request

SEED_BYTES = 7


def sweep_cloud(
    world: World, mounted: MountedLidar, things: MetThings, caster: CastBackend
) -> Cloud:
    """The sweep of a LiDAR that ends at the instant of ``world``; the same bits again for the same
    episode."""
    spec, lidar = mounted.spec, mounted.lidar
    request = sweep_request(world, lidar, things)
    echo = caster.cast(request)
    sweep = detect(echo, lidar, seed=sensor_seed(world, mounted.name))
    returned = _returns(sweep, echo, mounted)
    points = _points(world, returned, request, mounted)
    columns: dict[str, NDArray[Any]] = {
        "points": in_frame(points, spec.frame, lidar.T_vehicle_lidar)
    }
    columns |= {name: returned[name] for name in spec.fields}
    return Cloud(
        sensor=mounted.name,
        modality="lidar",
        t_us=world.t_us,
        duration_us=mounted.duration_us,
        frame=spec.frame,
        compensated=spec.compensated,
        T_vehicle_sensor=lidar.T_vehicle_lidar,
        T_world_sensor=world.T_world_estimate @ lidar.T_vehicle_lidar,
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
    world: World, returned: Mapping[str, NDArray[Any]], request: CastRequest, mounted: MountedLidar
) -> Float:
    """[N, 3] in the sensor's frame, at the instant of ``world`` where the cloud is compensated."""
    lidar, ray = mounted.lidar, returned["ray"]
    directions = lidar.beams.directions.reshape(-1, 3)[ray]
    points: Float = directions * returned["range"][:, None].astype(np.float64)
    if not mounted.spec.compensated:
        return points
    T_world_now = world.T_world_body @ lidar.T_vehicle_lidar
    relative = invert_transform(T_world_now) @ request.T_world_lidar
    of_ray = relative[lidar.beams.slots[1].ravel()[ray]]
    turned: Float = np.einsum("nij,nj->ni", of_ray[:, :3, :3], points) + of_ray[:, :3, 3]
    return turned
