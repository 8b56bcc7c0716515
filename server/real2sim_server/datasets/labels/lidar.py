"""Labelled points of a LiDAR: a sweep through the scene, told apart ray by ray."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.semantics import GROUND, STATIC, semantic_class

from ...geometry.rotation import Float
from ...geometry.transform import apply_transform, invert_transform
from ...render.cast import CastBackend, CastRequest, Echo, Sweep, detect
from ...render.lens import TOLERANCE
from ...scene import Ground, Lidar
from ..drive import Drive, Moment
from .boxes import ObjectBox
from .points import PointsByX, SeenPoints
from .surface import on_surface

SAME_SURFACE = 0.3
"""A return is of what the median of the light meets where it is no farther from it [m]."""


def lidar_points(
    drive: Drive,
    moment: Moment,
    boxes: Sequence[ObjectBox],
    lidar: Lidar,
    *,
    seed: int,
    caster: CastBackend,
) -> SeenPoints:
    """All returns of the sweep about a moment, rays in their order, near returns first.

    Args:
        drive: that is driven.
        moment: in the middle of the sweep of a spinning sensor.
        boxes: of the moment.
        lidar: the sensor.
        seed: of losses and range noise.
        caster: follows the rays.
    """
    met = drive.sweep_at(lidar, moment.t_us)
    request = met.things.request(lidar, met.T_world_lidar)
    echo = caster.cast(request)
    sweep = detect(echo, lidar, seed=seed)
    ray, ranges, number = _returns(sweep)
    slots = lidar.beams.slots[1].ravel()[ray]
    local = lidar.beams.directions.reshape(-1, 3)[ray] * ranges[:, None]
    points = _each(met.T_world_lidar[slots], local)
    instance, velocity = _objects(echo, request, (ray, ranges, slots), points, boxes)
    to_ego = invert_transform(moment.T_world_ego)
    return SeenPoints(
        points=apply_transform(to_ego, points).astype(np.float32),
        intensity=sweep.intensity.ravel()[ray],
        beam=_rows(lidar)[ray],
        instance=instance,
        semantic=_classes(instance, points, boxes, drive.scene.ground),
        velocity=(velocity @ to_ego[:3, :3].T).astype(np.float32),
        time_us=np.rint(sweep.time_us.ravel()[ray]).astype(np.int32),
        return_number=number,
    )


def _returns(sweep: Sweep) -> tuple[NDArray[np.int64], Float, NDArray[np.uint8]]:
    """Ray, range and number of each return; near ones first, equal ones once."""
    names = [name for name in ("first", "strongest", "last") if name in sweep.returns]
    ranges = [sweep.returns[name].ravel() for name in names] or [sweep.range.ravel()]
    each = np.sort(np.stack(ranges).astype(np.float64), axis=0)
    there = each > 0
    there[1:] &= each[1:] > each[:-1]
    number = np.cumsum(there, axis=0)
    ray, which = np.nonzero(there.T)
    return ray, each[which, ray], number[which, ray].astype(np.uint8)


def _rows(lidar: Lidar) -> NDArray[np.uint8]:
    """Row of each ray, the lowest is 0; 0 where the sensor has none."""
    if len(lidar.shape) != 2:
        return np.zeros(lidar.beams.count, np.uint8)
    elevation = lidar.beams.elevation.mean(axis=1)
    rank = np.argsort(np.argsort(elevation, kind="stable"), kind="stable")
    return np.repeat(rank.astype(np.uint8), lidar.shape[1])


def _objects(
    echo: Echo,
    request: CastRequest,
    returned: tuple[NDArray[np.int64], Float, NDArray[np.int32]],
    points: Float,
    boxes: Sequence[ObjectBox],
) -> tuple[NDArray[np.uint16], Float]:
    """Object of each return, and how it moves there in the world [m/s]: the object of the median
    where the return is on its surface, and of returns elsewhere the one in whose box they are,
    everything at the instant of the ray."""
    ray, ranges, slots = returned
    median = np.abs(echo.range.ravel()[ray] - ranges) <= SAME_SURFACE
    met = np.where(median, echo.instance.ravel()[ray], 0)
    found, velocity = np.zeros(len(ray), np.uint16), np.zeros((len(ray), 3))
    times = request.lidar.beams.slots[0]
    known = {box.instance_id: box for box in boxes}
    sought = PointsByX(points)
    for instance, poses in zip(request.instances, request.object_poses, strict=True):
        box = known.get(instance.instance_id)
        if box is None or poses is None:
            continue
        centre = poses[len(poses) // 2][:3, 3]
        reach = float(np.linalg.norm(box.size)) + SAME_SURFACE
        asked = sought.near(centre[0], reach)
        asked = asked[(met[asked] == instance.instance_id) | ~median[asked]]
        asked = asked[np.linalg.norm(points[asked] - centre, axis=1) < reach]
        local = _each(invert_transform(poses[slots[asked]]), points[asked])
        own = on_surface(local, np.eye(4), box)
        found[asked[own]] = instance.instance_id
        velocity[asked[own]] = _speed(poses, times, slots[asked[own]], local[own])
    return found, velocity


def _speed(poses: Float, times_us: Float, slots: NDArray[np.int32], local: Float) -> Float:
    """Velocity [N, 3] of points of a body, from where they are an instant before and after."""
    if len(times_us) < 2:
        return np.zeros_like(local)
    before, after = np.maximum(slots - 1, 0), np.minimum(slots + 1, len(times_us) - 1)
    moved = _each(poses[after], local) - _each(poses[before], local)
    speed: Float = moved / ((times_us[after] - times_us[before]) * 1e-6)[:, None]
    return speed


def _classes(
    instance: NDArray[np.uint16], points: Float, boxes: Sequence[ObjectBox], ground: Ground
) -> NDArray[np.uint8]:
    found = np.full(len(points), STATIC, np.uint8)
    background = instance == 0
    shown = points[background]
    above = np.abs(shown[:, 2] - ground.height_at(shown[:, :2]))
    found[background] = np.where(above < TOLERANCE, GROUND, STATIC)
    for box in boxes:
        found[instance == box.instance_id] = semantic_class(box.category)
    return found


def _each(transforms: Float, points: Float) -> Float:
    """Points [N, 3], each by its own transform [N, 4, 4]."""
    moved: Float = np.einsum("nij,nj->ni", transforms[:, :3, :3], points) + transforms[:, :3, 3]
    return moved
