"""From a log without boxes to tracks of everything that moves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float, yaw_quaternion
from ...geometry.transform import apply_transform, invert_transform
from ...scene import Trajectory
from ..driving_log import DrivingLog, LidarSweep, ObjectTrack
from .association import Track, follow
from .boxes import FittedBox, fit_box
from .clusters import Cluster, find_clusters
from .free_space import Witness

LONGEST, WIDEST, HIGHEST = 20.0, 3.9, 4.3
STRAIGHT = 0.6
"""Least share of the way that must lead from start to end: what jitters goes nowhere."""

EMPTY = 0.6
"""Least share of the places it has left that must be seen to be empty."""

FEW_POINTS = 20
MOST_POINTS = 200
LOOKS = 6
WITNESS_STEP = 4
MARGIN = 0.3
STEADY, SMALL = 0.4, 1.2
ROUGHEST = 0.5
"""A way that jumps about more than this [m] is of several things."""

JOIN_SPEED = 1.5
FEW_COMMON = 4
JOIN_SECONDS = 1.5
JOIN_DISTANCE = 1.0


@dataclass(frozen=True)
class TrackingOptions:
    """What counts as a moving object.

    Attributes:
        reach: how far from the vehicle objects are looked for [m], along each axis.
        least_distance: how far an object must go [m].
        least_speed: its least mean speed [m/s].
        least_frames: in how many frames it must be seen.
        patience: after how many frames without a sighting it is lost.
    """

    reach: float = 55.0
    least_distance: float = 1.5
    least_speed: float = 0.5
    least_frames: int = 6
    patience: int = 4


def track_moving_objects(
    log: DrivingLog,
    options: TrackingOptions | None = None,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[ObjectTrack, ...]:
    """Find what moves in the LiDAR sweeps of a log, with the log's own poses.

    The ground is taken away, what stands on it grouped, groups followed from frame to frame, and
    boxes of constant size fitted to those that really move: where a moving thing has been, nothing
    is afterwards.

    Args:
        log: with LiDAR; its tracks are not looked at.
        options: see there.
        on_progress: called with (done, total) after each sweep.

    Returns:
        Tracks in order of appearance, called ``<category>_<number>``; headings along the motion.

    Raises:
        LogError: a sweep cannot be read.
    """
    options = options or TrackingOptions()
    scans, witnesses = [], {}
    for frame in range(log.frame_count):
        pose, sweep = log.ego.transform(int(log.frame_times_us[frame])), log.lidar(frame)
        scans.append(find_clusters(sweep, pose, reach=options.reach, ego_size=log.ego_size))
        if frame % WITNESS_STEP == 0 or frame == log.frame_count - 1:
            witnesses[frame] = _witness(sweep, pose)
        if on_progress is not None:
            on_progress(frame + 1, log.frame_count)
    times = (log.frame_times_us - log.frame_times_us[0]) * 1e-6
    trails = follow(scans, times, patience=options.patience)
    moving = [t for t in trails if _goes_somewhere(t, times, options)]
    joined = [(part, fit_box(part, times)) for part in _join(moving, times)]
    boxes = [
        box
        for part, box in joined
        if _is_mover(part, box, times, options)
        and not _rides_along(log, box)
        and _leaves_nothing(part, box, witnesses)
    ]
    return _name(log, sorted(boxes, key=lambda box: int(box.frames[0])))


def _witness(sweep: LidarSweep, pose: Float) -> Witness:
    world = apply_transform(pose, sweep.points.astype(np.float64))
    sensor = apply_transform(pose, sweep.origin.astype(np.float64)[None])[0]
    return Witness(world.astype(np.float32), sensor)


def _goes_somewhere(trail: Track, times: Float, options: TrackingOptions) -> bool:
    """A first, cheap sieve: half of what is asked for in the end."""
    if len(trail.clusters) < max(3, options.least_frames // 2):
        return False
    frames = sorted(trail.clusters)
    centres = np.array([trail.clusters[f].centre for f in frames])
    ends = max(1, len(frames) // 5)
    gone = np.linalg.norm(centres[-ends:].mean(axis=0) - centres[:ends].mean(axis=0))
    seconds = times[frames[-1]] - times[frames[0]]
    return bool(gone > options.least_distance / 2 and gone > options.least_speed / 2 * seconds)


def _join(trails: Sequence[Track], times: Float) -> list[dict[int, Cluster]]:
    """Put together what is one thing: parts side by side, and trails that were cut in two."""
    parts = [dict(t.clusters) for t in trails]
    boxes = [fit_box(p, times) for p in parts]
    merged = True
    while merged:
        merged = False
        for i in range(len(parts)):
            for j in range(i + 1, len(parts)):
                if _belong_together(boxes[i], boxes[j], times):
                    parts[i] = _united(parts[i], parts.pop(j))
                    boxes.pop(j)
                    boxes[i] = fit_box(parts[i], times)
                    merged = True
                    break
            if merged:
                break
    return parts


def _belong_together(one: FittedBox, two: FittedBox, times: Float) -> bool:
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
        if len(common) > FEW_COMMON:
            return False
    early, late = (one, two) if one.frames[0] < two.frames[0] else (two, one)
    gap = times[late.frames[0]] - times[early.frames[-1]]
    if gap > JOIN_SECONDS or np.linalg.norm(early.velocities[-1] - late.velocities[0]) > 2.5:
        return False
    expected = early.centres[-1, :2] + gap * early.velocities[-1]
    reach = JOIN_DISTANCE + max(one.size[0], two.size[0]) / 2
    return bool(np.linalg.norm(expected - late.centres[0, :2]) < reach)


def _inside(box: FittedBox, index: int, places: Float) -> NDArray[np.bool_]:
    """Which places [..., >= 2] lie above or below the box, or next to it."""
    cos, sin = np.cos(box.headings[index]), np.sin(box.headings[index])
    x, y = places[..., 0] - box.centres[index, 0], places[..., 1] - box.centres[index, 1]
    along, across = cos * x + sin * y, cos * y - sin * x
    half = np.array(box.size[:2]) / 2 + MARGIN
    return np.asarray((np.abs(along) < half[0]) & (np.abs(across) < half[1]))


def _united(one: dict[int, Cluster], two: dict[int, Cluster]) -> dict[int, Cluster]:
    both = {**two, **one}
    for frame in set(one) & set(two):
        a, b = one[frame], two[frame]
        points = np.concatenate([a.points, b.points])
        middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
        both[frame] = Cluster(
            points, np.concatenate([a.offset, b.offset]), middle, min(a.ground, b.ground), a.sensor
        )
    return dict(sorted(both.items()))


def _is_mover(
    clusters: Mapping[int, Cluster], box: FittedBox, times: Float, options: TrackingOptions
) -> bool:
    length, width, height = box.size
    if len(clusters) < options.least_frames or length > LONGEST or width > WIDEST:
        return False
    steps = np.linalg.norm(np.diff(box.centres[:, :2], axis=0), axis=1)
    gone = float(np.linalg.norm(box.centres[-1, :2] - box.centres[0, :2]))
    seconds = times[box.frames[-1]] - times[box.frames[0]]
    if height > HIGHEST or gone < options.least_distance or box.residual > ROUGHEST:
        return False
    way = float(steps.sum())
    return way > options.least_speed * seconds and gone > STRAIGHT * way


def _rides_along(log: DrivingLog, box: FittedBox) -> bool:
    """Whether it is a part of the recording vehicle: small, and always at the same place on it."""
    poses = np.array([log.ego.transform(int(log.frame_times_us[f])) for f in box.frames])
    places = apply_transform(invert_transform(poses), box.centres[:, None])[:, 0]
    steady = np.abs(places - places.mean(axis=0)).max() < STEADY
    return bool(steady and max(box.size[:2]) < SMALL)


def _leaves_nothing(
    clusters: Mapping[int, Cluster], box: FittedBox, witnesses: Mapping[int, Witness]
) -> bool:
    """Whether the places where it was are seen to be empty when it is elsewhere.

    The visible part of a wall wanders as the vehicle drives by, but the wall stays.
    """
    frames = sorted(clusters)
    looked = [frames[round(i)] for i in np.linspace(0, len(frames) - 1, LOOKS).tolist()]
    free = occupied = 0
    for there, witness in witnesses.items():
        index = there - int(box.frames[0])
        if not 0 <= index < len(box.frames):
            continue
        for here in looked:
            points = clusters[here].points
            left = points[~_inside(box, index, points)]
            if len(left):
                found = witness.count(left[:: max(1, len(left) // MOST_POINTS)])
                free, occupied = free + found[0], occupied + found[1]
    return free + occupied >= FEW_POINTS and free > EMPTY * (free + occupied)


def _name(log: DrivingLog, boxes: Sequence[FittedBox]) -> tuple[ObjectTrack, ...]:
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
