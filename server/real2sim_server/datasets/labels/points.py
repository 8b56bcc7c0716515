"""Labelled points from camera depth or LiDAR sweeps, and point counts of boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from real2sim_proto.conventions import GROUND, STATIC, semantic_class

from ...geometry import Float, apply_transform, invert_transform
from ...render.cast import CastBackend, CastRequest, Echo, Sweep, detect
from ...render.lens import TOLERANCE, back_projected
from ...scene import Ground, Lidar
from ..drive import Drive, Moment
from .boxes import ObjectBox
from .images import CameraImages, on_surface

ROOF = (0.9, 0.0, 1.73)
"""Default position of a LiDAR, in the ego frame [m]."""
BEAMS, COLUMNS = 64, 1024
ELEVATION = (np.radians(-25.0), np.radians(3.0))
NEAR, FARTHEST = 1.0, 80.0
"""Range of horizontal distances with points [m]."""
NEAREST = 0.25
"""Maximum distance of a pixel from a beam, as a share of the gap between beams."""


def points_in_boxes(points: ArrayLike, transforms: ArrayLike, sizes: ArrayLike) -> list[int]:
    """Number of points in each box, including its faces, without a margin.

    Args:
        points: [N, 3] in some frame [m].
        transforms: [K, 4, 4] poses of the boxes in that frame, origin at the centre.
        sizes: [K, 3] (length, width, height) [m].
    """
    sought = PointsByX(np.asarray(points, dtype=np.float64))
    counts = []
    for transform, size in zip(np.asarray(transforms), np.asarray(sizes), strict=True):
        near = sought.points[sought.near(transform[0, 3], float(np.linalg.norm(size)) / 2 + 1e-6)]
        local = apply_transform(invert_transform(transform), near)
        counts.append(int((np.abs(local) <= size / 2).all(axis=1).sum()))
    return counts


class PointsByX:
    """Points sorted by x, so that a query scans only some of them."""

    def __init__(self, points: Float) -> None:
        """Sort [N, 3] points."""
        self.points = points
        self._order = np.argsort(points[:, 0])
        self._x = points[self._order, 0]

    def near(self, x: float, reach: float) -> NDArray[np.int64]:
        """Rows of the points whose x is within ``reach`` of ``x``."""
        first = np.searchsorted(self._x, x - reach, side="left")
        last = np.searchsorted(self._x, x + reach, side="right")
        return self._order[first:last]


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points on surfaces, from cameras or a LiDAR.

    Attributes:
        points: [N, 3] float32, ego frame [m].
        intensity: [N] float32, brightness of the pixel or reflectivity, 0 to 1.
        beam: [N] uint8, row of the sensor, 0 is the lowest; 0 for sensors without rows.
        instance: [N] uint16, 0 is background.
        semantic: [N] uint8, see SEMANTIC_CLASSES.
        velocity: [N, 3] float32, of the surface along the ego's axes [m/s].
        time_us: [N] int32, time of measurement relative to the frame.
        return_number: [N] uint8, 1 for the nearest of several returns of a ray.
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    beam: NDArray[np.uint8]
    instance: NDArray[np.uint16]
    semantic: NDArray[np.uint8]
    velocity: NDArray[np.float32]
    time_us: NDArray[np.int32]
    return_number: NDArray[np.uint8]


def seen_points(
    images: Sequence[CameraImages], boxes: Sequence[ObjectBox], T_world_ego: Float
) -> SeenPoints:
    """Points of the depth images along the beams of a spinning LiDAR on the roof.

    The nearest pixel of each beam is used, for the distribution of a LiDAR. Points outside the
    cameras' fields of view are missing.
    """
    to_ego = invert_transform(T_world_ego)
    parts = [_beams_of(image, to_ego) for image in images]
    points = np.concatenate([p[0] for p in parts])
    intensity, beam, column, instance, semantic = (
        np.concatenate([p[k] for p in parts]) for k in range(1, 6)
    )
    _, first = np.unique(beam * COLUMNS + column, return_index=True)
    kept = instance[first]
    return SeenPoints(
        points=points[first].astype(np.float32),
        intensity=intensity[first].astype(np.float32),
        beam=beam[first].astype(np.uint8),
        instance=kept,
        semantic=semantic[first],
        velocity=_velocities(points[first], kept, boxes, to_ego),
        time_us=np.zeros(len(first), np.int32),
        return_number=np.ones(len(first), np.uint8),
    )


def _beams_of(image: CameraImages, to_ego: Float) -> tuple[NDArray[np.generic], ...]:
    """Points, brightness, beam, column, instance and class of one pixel for each beam."""
    points = back_projected(image.depth, image.camera.K, to_ego @ image.T_world_camera)
    x, y, z = (points[..., k] - np.float32(ROOF[k]) for k in range(3))
    flat = np.sqrt(x * x + y * y)
    elevation = np.arctan(z / np.maximum(flat, NEAR))
    row = (elevation - ELEVATION[0]) * np.float32((BEAMS - 1) / (ELEVATION[1] - ELEVATION[0]))
    beam = np.rint(row)
    off = np.abs(row - beam)
    inside = (image.depth > 0) & (beam >= 0) & (beam < BEAMS) & (off < NEAREST)
    inside &= (flat > NEAR) & (flat < FARTHEST)
    chosen = np.flatnonzero(inside)
    azimuth = np.arctan2(y.ravel()[chosen], x.ravel()[chosen])
    turn = (azimuth * np.float32(COLUMNS / (2 * np.pi)) + COLUMNS // 2).astype(np.int64) % COLUMNS
    place = beam.ravel()[chosen].astype(np.int64) * COLUMNS + turn
    # The pixel nearest to the beam is written last and overwrites the others.
    farthest_first = np.argsort((off.ravel()[chosen] * -60_000).astype(np.int16), kind="stable")
    nearest = np.full(BEAMS * COLUMNS, -1)
    nearest[place[farthest_first]] = chosen[farthest_first]
    places = np.flatnonzero(nearest >= 0)
    chosen = nearest[places]
    return (
        points.reshape(-1, 3)[chosen],
        image.rgb.reshape(-1, 3)[chosen].mean(axis=1) / 255,
        places // COLUMNS,
        places % COLUMNS,
        image.instance.ravel()[chosen],
        image.semantic.ravel()[chosen],
    )


def _velocities(
    points: Float, instance: NDArray[np.uint16], boxes: Sequence[ObjectBox], to_ego: Float
) -> NDArray[np.float32]:
    found = np.zeros((len(points), 3), np.float32)
    for box in boxes:
        found[instance == box.instance_id] = to_ego[:3, :3] @ box.velocity
    return found


# --- LiDAR ---------------------------------------------------------------------------------------

# A sweep through the scene, labelled ray by ray.

SAME_SURFACE = 0.3
"""Maximum distance of a return from the median of the light on the same surface [m]."""


def lidar_points(
    drive: Drive,
    moment: Moment,
    boxes: Sequence[ObjectBox],
    lidar: Lidar,
    *,
    seed: int,
    caster: CastBackend,
) -> SeenPoints:
    """All returns of the sweep around a moment, ordered by ray, then from near to far.

    Args:
        drive: the drive.
        moment: state in the middle of the sweep of a spinning sensor.
        boxes: boxes at the moment.
        lidar: the sensor.
        seed: seed of losses and range noise.
        caster: casts the rays.
    """
    met = drive.sweep_at(lidar, moment.t_us)
    request = met.scene.request(lidar, met.T_world_lidar)
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
    """Ray, range and number of each return, near ones first, without duplicates."""
    names = [name for name in ("first", "strongest", "last") if name in sweep.returns]
    ranges = [sweep.returns[name].ravel() for name in names] or [sweep.range.ravel()]
    each = np.sort(np.stack(ranges).astype(np.float64), axis=0)
    there = each > 0
    there[1:] &= each[1:] > each[:-1]
    number = np.cumsum(there, axis=0)
    ray, which = np.nonzero(there.T)
    return ray, each[which, ray], number[which, ray].astype(np.uint8)


def _rows(lidar: Lidar) -> NDArray[np.uint8]:
    """Row of each ray, counted from the lowest; 0 if the sensor has no rows."""
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
    """Object of each return, and its velocity there in the world [m/s].

    The object is that of the median if the return is on its surface, otherwise the one whose box
    contains the return at the time of the ray.
    """
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
    """Velocity [N, 3] of points of a body, by central differences."""
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
    """Points [N, 3], transformed row by row by [N, 4, 4]."""
    moved: Float = np.einsum("nij,nj->ni", transforms[:, :3, :3], points) + transforms[:, :3, 3]
    return moved
