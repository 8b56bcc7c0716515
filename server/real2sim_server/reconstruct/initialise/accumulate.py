"""Sweeps of a whole log brought together: background in the world, objects in their boxes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float, apply_transform, invert_transform
from ...logs import DrivingLog, LidarSweep, ObjectTrack
from ...scene import Trajectory
from ..options import InitialiseOptions
from .points import PointSet, path_distance, thin, voxel_levels
from .walls import ScanLimit

HALF_SWEEP_US = 50_000
EGO_MARGIN = 0.45
"""Returns this close beside the recording vehicle are its own mirrors [m]."""
SHELL = 0.3
"""Above the road, what is this close to a box is dropped: boxes are not exact, and what sticks
out of a moving vehicle would leave a smear [m]."""
THIN_EVERY = 6_000_000
"""Points that may pile up before they are thinned, so that memory does not follow the drive."""


@dataclass(frozen=True, eq=False)
class Accumulation:
    """All sweeps of a log.

    Attributes:
        background: thinned points of everything that is in no box, world frame.
        objects: by object id, thinned points in the frame of the box (origin at its centre).
        limit: the highest rays of the scanner.
    """

    background: PointSet
    objects: dict[str, PointSet]
    limit: ScanLimit


def accumulate(
    log: DrivingLog, options: InitialiseOptions, on_frame: Callable[[int], None]
) -> Accumulation:
    """Bring all sweeps of ``log`` together.

    A point belongs to a tracked object when, at the moment it was measured, it lay inside the
    box enlarged by ``box_margin`` and above ``ground_clearance`` over the box bottom. Below that,
    what is level with the bottom is road; the rest, tyres and underbody, is dropped, and so are
    other points within SHELL of a box and returns from the recording vehicle itself. Everything
    else is background.
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
    """Tangent of the elevation that one ray in a thousand exceeds."""
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
    """All sweeps in order, read one ahead."""
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
    """Points, intensities and offsets [us] that are within range and not on the vehicle itself."""
    points = sweep.points.astype(np.float64)
    near = np.linalg.norm(points - sweep.origin, axis=1) < options.max_range
    on_vehicle = on_recording_vehicle(points, log.ego_size)
    used = near & ~on_vehicle & np.isfinite(points).all(axis=1)
    return points[used], sweep.intensity[used], sweep.offset_us[used].astype(np.float64)


def on_recording_vehicle(points: Float, size: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Which points [N, 3] of the vehicle's frame are returns of its own body."""
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
"""Points in a box at most so high over its bottom are road [m]."""


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
    """Indices of points near the box and their coordinates in it when they were measured."""
    centre = track.trajectory.pose(t_us)[0]
    velocity = track.trajectory.velocity(t_us)
    reach = np.linalg.norm(track.size) / 2 + SHELL + np.linalg.norm(velocity) * 0.1
    chosen = np.flatnonzero(np.abs(in_world[:, 0] - centre[0]) < reach)
    chosen = chosen[np.abs(in_world[chosen, 1] - centre[1]) < reach]
    early, late = (
        invert_transform(pose_around(track.trajectory, t_us + sign * HALF_SWEEP_US))
        for sign in (-1, 1)
    )
    # Within half a turn of the scanner the path of a point in the box is straight to a millimetre.
    fraction = (offset_us[chosen] / (2 * HALF_SWEEP_US) + 0.5)[:, None]
    points = in_world[chosen]
    in_box = apply_transform(early, points) * (1 - fraction)
    return chosen, in_box + apply_transform(late, points) * fraction


def pose_around(trajectory: Trajectory, t_us: int) -> Float:
    """``T_world_object`` [4, 4]; just outside its time range it goes on with constant velocity."""
    inside = min(max(t_us, trajectory.start_us), trajectory.end_us)
    pose = trajectory.transform(inside)
    pose[:3, 3] += trajectory.velocity(inside) * (t_us - inside) * 1e-6
    return pose
