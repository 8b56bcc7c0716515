"""Points of a whole log: accumulated sweeps, thinned, and walls above the field of view."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...logs import DrivingLog, LidarSweep, ObjectTrack
from ...scene import Trajectory
from ..options import InitialiseOptions
from .surfels import Surfels

# Measured points and their thinning.

_BITS = 20
_HALF = 1 << (_BITS - 1)
MAX_LEVEL = 7


@dataclass(frozen=True, eq=False)
class PointSet:
    """LiDAR points in one frame.

    Attributes:
        points: [N, 3] float32 [m].
        intensity: [N] float32 in [0, 1].
        weight: [N] float32, number of measurements that a point represents.
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    weight: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> PointSet:
        """The points selected by a mask or by indices."""
        return PointSet(self.points[index], self.intensity[index], self.weight[index])

    @classmethod
    def measured(cls, points: Float, intensity: NDArray[np.float32]) -> PointSet:
        """Points that represent one measurement each."""
        return cls(
            points.astype(np.float32),
            intensity.astype(np.float32),
            np.ones(len(points), dtype=np.float32),
        )

    @classmethod
    def join(cls, parts: list[PointSet]) -> PointSet:
        """All points of ``parts``, in order."""
        if not parts:
            return cls.measured(np.zeros((0, 3)), np.zeros(0, dtype=np.float32))
        return cls(
            np.concatenate([p.points for p in parts]),
            np.concatenate([p.intensity for p in parts]),
            np.concatenate([p.weight for p in parts]),
        )


def thin(cloud: PointSet, voxel: float, levels: NDArray[np.int64] | None = None) -> PointSet:
    """One point per occupied voxel: the weighted mean of the points inside.

    Args:
        cloud: any number of points.
        voxel: edge of a voxel of level 0 [m].
        levels: [N] in 0 to MAX_LEVEL, the edge doubles with each level; all 0 by default. Points
            of different levels are never merged.

    Returns:
        The means in the order of their voxels, with the same total weight.
    """
    if len(cloud) == 0:
        return cloud
    order, starts = _group(_voxel_keys(cloud.points, voxel, levels))
    weight = cloud.weight[order].astype(np.float64)
    total = np.add.reduceat(weight, starts)
    points = cloud.points[order].astype(np.float64) * weight[:, None]
    intensity = cloud.intensity[order].astype(np.float64) * weight
    return PointSet(
        (np.add.reduceat(points, starts, axis=0) / total[:, None]).astype(np.float32),
        (np.add.reduceat(intensity, starts) / total).astype(np.float32),
        total.astype(np.float32),
    )


def thin_to(
    cloud: PointSet, voxel: float, limit: int, levels: NDArray[np.int64] | None = None
) -> PointSet:
    """Like :func:`thin`, with voxels enlarged to stay within ``limit`` points."""
    thinned = thin(cloud, voxel, levels)
    while len(thinned) > limit:
        # Points are on surfaces, so their number falls with the square of the edge.
        voxel *= max(1.05, (len(thinned) / limit) ** 0.5)
        thinned = thin(cloud, voxel, levels)
    return thinned


def _voxel_keys(
    points: NDArray[np.float32], voxel: float, levels: NDArray[np.int64] | None
) -> NDArray[np.int64]:
    edge = voxel if levels is None else (voxel * np.exp2(levels))[:, None]
    cells = np.floor(points.astype(np.float64) / edge).astype(np.int64)
    cells = np.clip(cells + _HALF, 0, 2 * _HALF - 1)
    key = (cells[:, 0] << (2 * _BITS)) | (cells[:, 1] << _BITS) | cells[:, 2]
    return key if levels is None else key | (levels << (3 * _BITS))


def _group(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Stable order that groups equal keys, and the start of each group."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    return order, starts


def path_distance(points: NDArray[np.float32], path: Float) -> NDArray[np.float32]:
    """Distance [N] [m] of points [N, 3] from the nearest of ``path`` [P, 3], to about a metre.

    All points of one metre cell get the same value, so that levels change between cells only.
    """
    from scipy.spatial import cKDTree

    cells, inverse = _unique_cells(points)
    distance, _ = cKDTree(path).query(cells + 0.5, workers=-1)
    return np.asarray(distance.astype(np.float32)[inverse])


def _unique_cells(points: NDArray[np.float32]) -> tuple[Float, NDArray[np.int64]]:
    keys = _voxel_keys(points, 1.0, None)
    unique, inverse = np.unique(keys, return_inverse=True)
    mask = 2 * _HALF - 1
    parts = [(unique >> (2 * _BITS)) & mask, (unique >> _BITS) & mask, unique & mask]
    return np.stack(parts, axis=1).astype(np.float64) - _HALF, inverse


def voxel_levels(distance: NDArray[np.float32], voxel: float, growth: float) -> NDArray[np.int64]:
    """Levels [N] for :func:`thin`: the voxel nearest below ``max(voxel, growth * distance)``."""
    ratio = np.maximum(distance * (growth / voxel), 1.0)
    return np.asarray(np.clip(np.floor(np.log2(ratio)), 0, MAX_LEVEL), dtype=np.int64)


def well_supported(points: NDArray[np.float32], reach: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask [N] of points with three others within their ``reach`` [N] [m]; isolated points are
    noise.
    """
    from scipy.spatial import cKDTree

    if len(points) < 4:
        return np.zeros(len(points), dtype=np.bool_)
    third, _ = cKDTree(points).query(points, k=[4], workers=-1)
    return np.asarray(third[:, 0] < reach)


# Walls above the LiDAR's field of view.
#
# A spinning LiDAR covers only a few degrees above the horizon. Walls that reach its upper limit
# are continued straight up. Images then decide which part is real.

CELL = 0.25
"""Edge of the columns for the detection of walls [m]."""
REACH, HEIGHT = 45.0, 14.0
"""Walls within this distance of the drive are continued, and their added height [m]."""
MIN_POINTS, MIN_EXTENT = 6, 0.8
"""Minimum number of points and minimum height of a wall column [m]."""
MAX_DEVIATION = 28.0
"""Maximum standard deviation of a real wall's brightness between views, 0 to 255."""


@dataclass(frozen=True, eq=False)
class ScanLimit:
    """The highest rays of the scanner.

    Attributes:
        path: [P, 3] float64, positions of the vehicle in the world [m].
        height: height of the scanner above the vehicle's origin [m].
        slope: tangent of the elevation of its highest ray.
    """

    path: Float
    height: float
    slope: float


def continue_walls(structure: Surfels, limit: ScanLimit, *, max_count: int) -> Surfels:
    """Surfels on walls above the scanner's field of view; their colours decide which are real.

    Args:
        structure: objects above the ground, world frame.
        limit: highest rays of the scanner.
        max_count: maximum number; the spacing grows if needed.
    """
    columns = _wall_columns(structure, limit)
    step = CELL
    while len(columns.start) * int(HEIGHT / step) > max_count:
        step *= 1.25
        if step > 4 * CELL:
            columns = columns.every_other()
            step = CELL
    return _rise(columns, step)


@dataclass(frozen=True, eq=False)
class _Columns:
    """Wall columns: xy [C, 2], direction [C] of the normal [rad], start [C] height in the world."""

    xy: Float
    direction: Float
    start: Float

    def every_other(self) -> _Columns:
        return _Columns(self.xy[::2], self.direction[::2], self.start[::2])


def _wall_columns(structure: Surfels, limit: ScanLimit) -> _Columns:
    from scipy.spatial import cKDTree

    upright = np.abs(structure.normals[:, 2]) < 0.3
    points = structure.points[upright].astype(np.float64)
    normals = structure.normals[upright].astype(np.float64)
    if len(points) == 0:
        return _Columns(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    cells = np.floor(points[:, :2] / CELL).astype(np.int64)
    _, index, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    xy = np.stack([np.bincount(index, points[:, a]) for a in (0, 1)], axis=1) / counts[:, None]
    top, bottom = np.full(len(counts), -np.inf), np.full(len(counts), np.inf)
    np.maximum.at(top, index, points[:, 2])
    np.minimum.at(bottom, index, points[:, 2])
    # A normal and its opposite are the same wall, hence the doubled angle.
    angle = 2 * np.arctan2(normals[:, 1], normals[:, 0])
    cosine, sine = (np.bincount(index, f(angle)) / counts for f in (np.cos, np.sin))
    distance, nearest = cKDTree(limit.path[:, :2]).query(xy, workers=-1)
    seen_up_to = limit.path[nearest, 2] + limit.height + limit.slope * distance
    wall = (
        (counts >= MIN_POINTS)
        & (top - bottom > MIN_EXTENT)
        & (np.hypot(cosine, sine) > 0.7)
        & (top > seen_up_to - 0.1)
        & (distance < REACH)
    )
    return _Columns(xy[wall], np.arctan2(sine, cosine)[wall] / 2, seen_up_to[wall])


def _rise(columns: _Columns, step: float) -> Surfels:
    levels = (np.arange(int(HEIGHT / step)) + 0.5) * step
    count, rows = len(columns.start), len(levels)
    points = np.empty((count, rows, 3))
    points[..., :2] = columns.xy[:, None]
    points[..., 2] = columns.start[:, None] + levels
    c, s = np.cos(columns.direction), np.sin(columns.direction)
    zero, one = np.zeros(count), np.ones(count)
    along = np.stack([-s, c, zero], axis=1)
    up = np.stack([zero, zero, one], axis=1)
    normal = np.stack([c, s, zero], axis=1)
    axes = np.stack([along, up, normal], axis=2)
    scales = np.tile(np.array([0.6 * CELL, 0.6 * step, 0.03]), (count * rows, 1))
    return Surfels(
        points.reshape(-1, 3).astype(np.float32),
        np.repeat(axes, rows, axis=0).astype(np.float32),
        scales.astype(np.float32),
    )


def real_walls(
    colours: NDArray[np.float32], known: NDArray[np.bool_], deviation: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Mask [N] of candidates that are walls: seen, alike in all views, not coloured like the sky.

    Args:
        colours: [N, 3] float32 in [0, 1].
        known: [N] bool.
        deviation: [N] float32, standard deviation of brightness between views, 0 to 255.
    """
    red, blue = colours[:, 0], colours[:, 2]
    blown_out = colours.min(axis=1) > 0.9
    bluish = (blue > red + 0.02) & (blue > 0.45)
    return np.asarray(known & (deviation < MAX_DEVIATION) & ~blown_out & ~bluish)


# Accumulated sweeps: background in the world frame, objects in their boxes.

HALF_SWEEP_US = 50_000
EGO_MARGIN = 0.45
"""Returns this close to the sides of the recording vehicle come from its mirrors [m]."""
SHELL = 0.3
"""Points above the road this close to a box are dropped [m]: boxes are inexact, and parts of a
moving vehicle outside its box would leave a smear.
"""
THIN_EVERY = 6_000_000
"""Maximum number of points before thinning. Bounds the memory for long drives."""


@dataclass(frozen=True, eq=False)
class Accumulation:
    """All sweeps of a log.

    Attributes:
        background: thinned points outside all boxes, world frame.
        objects: by object id, thinned points in the frame of the box (origin at its centre).
        limit: the highest rays of the scanner.
    """

    background: PointSet
    objects: dict[str, PointSet]
    limit: ScanLimit


def accumulate(
    log: DrivingLog, options: InitialiseOptions, on_frame: Callable[[int], None]
) -> Accumulation:
    """Accumulate all sweeps of ``log``.

    A point belongs to a tracked object if, at its time of measurement, it was inside the box
    enlarged by ``box_margin`` and more than ``ground_clearance`` above the box bottom. Below that
    height, points level with the bottom are road. The others (tyres, underbody) are dropped, as are
    points within SHELL of a box and returns from the recording vehicle itself. Everything else is
    background.
    """
    path = drive_path(log)
    background: list[PointSet] = []
    objects: dict[str, list[PointSet]] = {t.object_id: [] for t in log.tracks}
    pending, highest, heights = 0, [0.0], [0.0]
    for frame, sweep in _sweeps(log):
        points, intensity, offset_us = _usable(sweep, log, options)
        if len(points):
            highest.append(_highest_slope(points - sweep.origin))
            heights.append(float(sweep.origin[2]))
        in_world = apply_transform(log.ego.transform(int(log.frame_times_us[frame])), points)
        owner, local = _assign(in_world, offset_us, log, frame, options)
        for index, track in enumerate(log.tracks):
            mine = owner == index
            if mine.any():
                objects[track.object_id].append(PointSet.measured(local[mine], intensity[mine]))
        free = owner == _BACKGROUND
        background.append(PointSet.measured(in_world[free], intensity[free]))
        pending += int(free.sum())
        if pending > THIN_EVERY:
            background, pending = [_thin_background(background, path, options)], 0
        on_frame(frame)
    return Accumulation(
        background=_thin_background(background, path, options),
        objects={k: thin(PointSet.join(v), options.object_voxel) for k, v in objects.items()},
        limit=ScanLimit(path, heights[-1], float(np.median(highest))),
    )


def _highest_slope(rays: Float) -> float:
    """Tangent of the elevation that one ray in a thousand exceeds (99.9th percentile)."""
    return float(np.quantile(rays[:, 2] / np.hypot(rays[:, 0], rays[:, 1]), 0.999))


def drive_path(log: DrivingLog) -> Float:
    """Positions [P, 3] of the recording vehicle, at most about a metre apart per frame."""
    positions = np.array([log.ego.pose(int(t))[0] for t in log.frame_times_us])
    kept = [0]
    for i in range(1, len(positions)):
        if np.linalg.norm(positions[i] - positions[kept[-1]]) > 0.5:
            kept.append(i)
    return positions[kept]


def _thin_background(parts: list[PointSet], path: Float, options: InitialiseOptions) -> PointSet:
    cloud = PointSet.join(parts)
    if len(cloud) == 0:
        return cloud
    distance = path_distance(cloud.points, path)
    levels = voxel_levels(distance, options.voxel, options.voxel_per_metre)
    return thin(cloud, options.voxel, levels)


def _sweeps(log: DrivingLog) -> Iterator[tuple[int, LidarSweep]]:
    """All sweeps in order, prefetched by one."""
    with ThreadPoolExecutor(1) as reader:
        ahead = reader.submit(log.lidar, 0)
        for frame in range(log.frame_count):
            sweep = ahead.result()
            if frame + 1 < log.frame_count:
                ahead = reader.submit(log.lidar, frame + 1)
            yield frame, sweep


def _usable(
    sweep: LidarSweep, log: DrivingLog, options: InitialiseOptions
) -> tuple[Float, NDArray[np.float32], Float]:
    """Points, intensities and offsets [us] within range and not on the recording vehicle."""
    points = sweep.points.astype(np.float64)
    near = np.linalg.norm(points - sweep.origin, axis=1) < options.max_range
    on_vehicle = on_recording_vehicle(points, log.ego_size)
    used = near & ~on_vehicle & np.isfinite(points).all(axis=1)
    return points[used], sweep.intensity[used], sweep.offset_us[used].astype(np.float64)


def on_recording_vehicle(points: Float, size: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Mask [N] of the points [N, 3] (vehicle frame) on the vehicle's body."""
    length, width, height = size
    return (
        (points[:, 0] > -0.3 * length)
        & (points[:, 0] < 0.85 * length)
        & (np.abs(points[:, 1]) < width / 2 + EGO_MARGIN)
        & (points[:, 2] > 0.1)
        & (points[:, 2] < height + 0.6)
    )


_BACKGROUND, _DROPPED = -1, -2
ROAD_BAND = 0.05
"""Maximum height of road points above the bottom of a box [m]."""


def _assign(
    in_world: Float, offset_us: Float, log: DrivingLog, frame: int, options: InitialiseOptions
) -> tuple[NDArray[np.int64], Float]:
    """Index of the track each point belongs to, or _BACKGROUND, and its position in that box."""
    in_world = np.asfortranarray(in_world)
    owner = np.full(len(in_world), _BACKGROUND)
    local = np.zeros_like(in_world)
    nearest = np.full(len(in_world), np.inf)
    t_us = int(log.frame_times_us[frame])
    for index, track in enumerate(log.tracks):
        if not track.trajectory.covers(t_us):
            continue
        chosen, in_box = near_box(in_world, offset_us, track, t_us)
        half = np.array(track.size) / 2
        outside = (np.abs(in_box) - half).max(axis=1)
        height = in_box[:, 2] + half[2]
        inside = outside <= options.box_margin
        stray = (outside <= SHELL) & (height > ROAD_BAND) & (owner[chosen] == _BACKGROUND)
        owner[chosen[stray]] = _DROPPED
        mine = inside & (height > options.ground_clearance) & (outside < nearest[chosen])
        owner[chosen[mine]] = index
        local[chosen[mine]] = in_box[mine]
        nearest[chosen[mine]] = outside[mine]
    return owner, local


def near_box(
    in_world: Float, offset_us: Float, track: ObjectTrack, t_us: int
) -> tuple[NDArray[np.int64], Float]:
    """Indices of points near the box, and their coordinates in it at their times of measurement."""
    centre = track.trajectory.pose(t_us)[0]
    velocity = track.trajectory.velocity(t_us)
    reach = np.linalg.norm(track.size) / 2 + SHELL + np.linalg.norm(velocity) * 0.1
    chosen = np.flatnonzero(np.abs(in_world[:, 0] - centre[0]) < reach)
    chosen = chosen[np.abs(in_world[chosen, 1] - centre[1]) < reach]
    early, late = (
        invert_transform(pose_around(track.trajectory, t_us + sign * HALF_SWEEP_US))
        for sign in (-1, 1)
    )
    # Within half a turn of the scanner, a point's path in the box is straight to a millimetre.
    fraction = (offset_us[chosen] / (2 * HALF_SWEEP_US) + 0.5)[:, None]
    points = in_world[chosen]
    in_box = apply_transform(early, points) * (1 - fraction)
    return chosen, in_box + apply_transform(late, points) * fraction


def pose_around(trajectory: Trajectory, t_us: int) -> Float:
    """``T_world_object`` [4, 4]; constant velocity just outside its time range."""
    inside = min(max(t_us, trajectory.start_us), trajectory.end_us)
    pose = trajectory.transform(inside)
    pose[:3, 3] += trajectory.velocity(inside) * (t_us - inside) * 1e-6
    return pose
