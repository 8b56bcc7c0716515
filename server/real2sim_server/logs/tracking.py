"""Tracks of all moving objects from a log without boxes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float, apply_transform, invert_transform, yaw_quaternion
from ..scene import Trajectory
from .association import (
    FittedBox,
    LidarCluster,
    SweepRays,
    Track,
    associate,
    find_clusters,
    fit_box,
)
from .driving_log import DrivingLog, LidarSweep, ObjectTrack

MAX_LENGTH, MAX_WIDTH, MAX_HEIGHT = 20.0, 3.9, 4.3
MIN_STRAIGHTNESS = 0.6
"""Minimum displacement as a fraction of the path length; lower values are jitter."""

MIN_FREE_FRACTION = 0.6
"""Minimum fraction of the tested points at former positions that are observed free."""

MIN_TESTED_POINTS = 20
MAX_TESTED_POINTS = 200
TESTED_FRAMES = 6
RAYS_EVERY = 4
MARGIN = 0.3
EGO_PART_MOTION, EGO_PART_SIZE = 0.4, 1.2
MAX_RESIDUAL = 0.5
"""Maximum residual of a fit [m]; a track with a larger one contains several objects."""

JOIN_SPEED = 1.5
MAX_COMMON_APART = 4
JOIN_SECONDS = 1.5
JOIN_DISTANCE = 1.0


@dataclass(frozen=True)
class TrackingOptions:
    """Criteria for moving objects.

    Attributes:
        reach: maximum distance from the vehicle along each axis [m].
        min_distance: minimum travelled distance [m].
        min_speed: minimum mean speed [m/s].
        min_frames: minimum number of frames with the object.
        max_missed: a track ends after this many frames without a cluster.
    """

    reach: float = 55.0
    min_distance: float = 1.5
    min_speed: float = 0.5
    min_frames: int = 6
    max_missed: int = 4


def track_moving_objects(
    log: DrivingLog,
    options: TrackingOptions | None = None,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[ObjectTrack, ...]:
    """Detect and track moving objects in the LiDAR sweeps of a log, using the log's poses.

    Ground points are removed, the rest is clustered, clusters are associated from frame to frame,
    and boxes of constant size are fitted to the moving tracks: a moving object leaves free space at
    its former positions.

    Args:
        log: log with LiDAR; its tracks are ignored.
        options: see :class:`TrackingOptions`.
        on_progress: called with (done, total) after each sweep.

    Returns:
        Tracks in order of appearance, named ``<category>_<number>``; headings along the motion.

    Raises:
        LogError: a sweep cannot be read.
    """
    options = options or TrackingOptions()
    scans, rays_by_frame = [], {}
    for frame in range(log.frame_count):
        pose, sweep = log.ego.transform(int(log.frame_times_us[frame])), log.lidar(frame)
        scans.append(find_clusters(sweep, pose, reach=options.reach, ego_size=log.ego_size))
        if frame % RAYS_EVERY == 0 or frame == log.frame_count - 1:
            rays_by_frame[frame] = _sweep_rays(sweep, pose)
        if on_progress is not None:
            on_progress(frame + 1, log.frame_count)
    times = (log.frame_times_us - log.frame_times_us[0]) * 1e-6
    tracks = associate(scans, times, max_missed=options.max_missed)
    moving = [t for t in tracks if _has_moved(t, times, options)]
    joined = [(part, fit_box(part, times)) for part in _merge_tracks(moving, times)]
    boxes = [
        box
        for part, box in joined
        if _moves_like_object(part, box, times, options)
        and not _is_part_of_ego(log, box)
        and _vacates_positions(part, box, rays_by_frame)
    ]
    return _named_tracks(log, sorted(boxes, key=lambda box: int(box.frames[0])))


def _sweep_rays(sweep: LidarSweep, pose: Float) -> SweepRays:
    world = apply_transform(pose, sweep.points.astype(np.float64))
    sensor = apply_transform(pose, sweep.origin.astype(np.float64)[None])[0]
    return SweepRays(world.astype(np.float32), sensor)


def _has_moved(track: Track, times: Float, options: TrackingOptions) -> bool:
    """A fast first test with half of the required distance and speed."""
    if len(track.clusters) < max(3, options.min_frames // 2):
        return False
    frames = sorted(track.clusters)
    centres = np.array([track.clusters[f].centre for f in frames])
    ends = max(1, len(frames) // 5)
    displacement = np.linalg.norm(centres[-ends:].mean(axis=0) - centres[:ends].mean(axis=0))
    seconds = times[frames[-1]] - times[frames[0]]
    return bool(
        displacement > options.min_distance / 2 and displacement > options.min_speed / 2 * seconds
    )


def _merge_tracks(tracks: Sequence[Track], times: Float) -> list[dict[int, LidarCluster]]:
    """Merge the tracks of one object: parts next to each other, and interrupted tracks."""
    parts = [dict(t.clusters) for t in tracks]
    boxes = [fit_box(p, times) for p in parts]
    merged = True
    while merged:
        merged = False
        for i in range(len(parts)):
            for j in range(i + 1, len(parts)):
                if _same_object(boxes[i], boxes[j], times):
                    parts[i] = _merged_clusters(parts[i], parts.pop(j))
                    boxes.pop(j)
                    boxes[i] = fit_box(parts[i], times)
                    merged = True
                    break
            if merged:
                break
    return parts


def _same_object(one: FittedBox, two: FittedBox, times: Float) -> bool:
    common = np.intersect1d(one.frames, two.frames)
    if len(common):
        a, b = common - one.frames[0], common - two.frames[0]
        together = [
            bool(_inside(one, i, two.centres[j]) or _inside(two, j, one.centres[i]))
            for i, j in zip(a.tolist(), b.tolist(), strict=True)
        ]
        differ = np.linalg.norm(one.velocities[a] - two.velocities[b], axis=1).mean()
        if np.mean(together) > 0.5:
            return bool(differ < JOIN_SPEED)
        if len(common) > MAX_COMMON_APART:
            return False
    early, late = (one, two) if one.frames[0] < two.frames[0] else (two, one)
    gap = times[late.frames[0]] - times[early.frames[-1]]
    if gap > JOIN_SECONDS or np.linalg.norm(early.velocities[-1] - late.velocities[0]) > 2.5:
        return False
    expected = early.centres[-1, :2] + gap * early.velocities[-1]
    reach = JOIN_DISTANCE + max(one.size[0], two.size[0]) / 2
    return bool(np.linalg.norm(expected - late.centres[0, :2]) < reach)


def _inside(box: FittedBox, index: int, positions: Float) -> NDArray[np.bool_]:
    """Mask of positions [..., >= 2] inside the box seen from above, with a margin."""
    cos, sin = np.cos(box.headings[index]), np.sin(box.headings[index])
    x, y = positions[..., 0] - box.centres[index, 0], positions[..., 1] - box.centres[index, 1]
    along, across = cos * x + sin * y, cos * y - sin * x
    half = np.array(box.size[:2]) / 2 + MARGIN
    return np.asarray((np.abs(along) < half[0]) & (np.abs(across) < half[1]))


def _merged_clusters(
    one: dict[int, LidarCluster], two: dict[int, LidarCluster]
) -> dict[int, LidarCluster]:
    both = {**two, **one}
    for frame in set(one) & set(two):
        a, b = one[frame], two[frame]
        points = np.concatenate([a.points, b.points])
        middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
        both[frame] = LidarCluster(
            points, np.concatenate([a.offset, b.offset]), middle, min(a.ground, b.ground), a.sensor
        )
    return dict(sorted(both.items()))


def _moves_like_object(
    clusters: Mapping[int, LidarCluster], box: FittedBox, times: Float, options: TrackingOptions
) -> bool:
    length, width, height = box.size
    if len(clusters) < options.min_frames or length > MAX_LENGTH or width > MAX_WIDTH:
        return False
    steps = np.linalg.norm(np.diff(box.centres[:, :2], axis=0), axis=1)
    displacement = float(np.linalg.norm(box.centres[-1, :2] - box.centres[0, :2]))
    seconds = times[box.frames[-1]] - times[box.frames[0]]
    if height > MAX_HEIGHT or displacement < options.min_distance or box.residual > MAX_RESIDUAL:
        return False
    path_length = float(steps.sum())
    return (
        path_length > options.min_speed * seconds and displacement > MIN_STRAIGHTNESS * path_length
    )


def _is_part_of_ego(log: DrivingLog, box: FittedBox) -> bool:
    """Whether it is a part of the recording vehicle: small, and steady in the vehicle frame."""
    poses = np.array([log.ego.transform(int(log.frame_times_us[f])) for f in box.frames])
    positions = apply_transform(invert_transform(poses), box.centres[:, None])[:, 0]
    steady = np.abs(positions - positions.mean(axis=0)).max() < EGO_PART_MOTION
    return bool(steady and max(box.size[:2]) < EGO_PART_SIZE)


def _vacates_positions(
    clusters: Mapping[int, LidarCluster], box: FittedBox, rays_by_frame: Mapping[int, SweepRays]
) -> bool:
    """Whether its former positions are observed free when it is elsewhere.

    The visible part of a wall moves along as the vehicle drives by, but the wall stays.
    """
    frames = sorted(clusters)
    tested_frames = [
        frames[round(i)] for i in np.linspace(0, len(frames) - 1, TESTED_FRAMES).tolist()
    ]
    free = occupied = 0
    for frame, rays in rays_by_frame.items():
        index = frame - int(box.frames[0])
        if not 0 <= index < len(box.frames):
            continue
        for tested in tested_frames:
            points = clusters[tested].points
            left = points[~_inside(box, index, points)]
            if len(left):
                found = rays.count(left[:: max(1, len(left) // MAX_TESTED_POINTS)])
                free, occupied = free + found[0], occupied + found[1]
    return free + occupied >= MIN_TESTED_POINTS and free > MIN_FREE_FRACTION * (free + occupied)


def _named_tracks(log: DrivingLog, boxes: Sequence[FittedBox]) -> tuple[ObjectTrack, ...]:
    numbers: Counter[str] = Counter()
    tracks = []
    for box in boxes:
        category = box.category
        times_us = log.frame_times_us[box.frames]
        tracks.append(
            ObjectTrack(
                object_id=f"{category}_{numbers[category]}",
                category=category,
                size=box.size,
                trajectory=Trajectory(times_us, box.centres, yaw_quaternion(box.headings)),
            )
        )
        numbers[category] += 1
    return tuple(tracks)


# --- Merging -------------------------------------------------------------------------------------

# Detected tracks in addition to those of the log.

INSTANTS = 9
"""Number of common instants at which two tracks are compared."""


def merge_tracks(
    given: Sequence[ObjectTrack], found: Sequence[ObjectTrack]
) -> tuple[ObjectTrack, ...]:
    """``given``, then the tracks of ``found`` that are not among them, with new ids."""
    tracks = list(given)
    taken = {track.object_id for track in given}
    for track in found:
        if any(same_object(track, other) for other in given):
            continue
        number = count()
        object_id = track.object_id
        while object_id in taken:
            object_id = f"{track.category}_{next(number)}"
        taken.add(object_id)
        tracks.append(replace(track, object_id=object_id))
    return tuple(tracks)


def same_object(track: ObjectTrack, other: ObjectTrack) -> bool:
    """Whether a track is inside the box of another for half of their common time."""
    first = max(track.trajectory.start_us, other.trajectory.start_us)
    last = min(track.trajectory.end_us, other.trajectory.end_us)
    if last < first:
        return False
    inside = 0
    times = np.linspace(first, last, INSTANTS).astype(np.int64)
    for t_us in times:
        T_other_world = np.linalg.inv(other.trajectory.transform(int(t_us)))
        centre = T_other_world @ track.trajectory.transform(int(t_us))[:, 3]
        inside += bool((np.abs(centre[:3]) <= np.array(other.size) / 2).all())
    return 2 * inside >= len(times)
