"""Turns boxes of single frames into tracks."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ...geometry.rotation import Float
from ...scene import SceneError, Trajectory
from ..driving_log import LogError, ObjectTrack


@dataclass(frozen=True, eq=False)
class FrameBox:
    """One object in one frame.

    Attributes:
        key: the dataset's own name of the track.
        category: in the project's words.
        size: (length, width, height) [m].
        time_us: [us].
        T_world_object: [4, 4], origin at the box centre, x forward, z up.
        where: file and row, for errors.
    """

    key: str
    category: str
    size: tuple[float, float, float]
    time_us: int
    T_world_object: Float
    where: str


def upright_pose(centre: Iterable[float], heading: float) -> Float:
    """``T_frame_object`` [4, 4] of a box that is only turned about z by ``heading`` [rad]."""
    pose = np.eye(4)
    cos, sin = np.cos(heading), np.sin(heading)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:3, 3] = list(centre)
    return pose


def build_tracks(boxes: Iterable[FrameBox]) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    """Tracks in order of first appearance, and the dataset's name of each by object id.

    An object has its median size and its most frequent category; it is called
    ``<category>_<number>``.

    Raises:
        LogError: a size that is not positive, a pose that is not finite or no rigid transform, or
            two boxes of one object at one instant.
    """
    by_key: dict[str, list[FrameBox]] = defaultdict(list)
    for box in sorted(boxes, key=lambda b: (b.time_us, b.key)):
        _check(box)
        by_key[box.key].append(box)
    numbers: Counter[str] = Counter()
    tracks, keys = [], {}
    for key, members in by_key.items():
        category = Counter(b.category for b in members).most_common(1)[0][0]
        object_id = f"{category}_{numbers[category]}"
        numbers[category] += 1
        keys[object_id] = key
        length, width, height = np.median([b.size for b in members], axis=0).tolist()
        tracks.append(
            ObjectTrack(object_id, category, (length, width, height), _trajectory(key, members))
        )
    return tuple(tracks), keys


def _check(box: FrameBox) -> None:
    if not (np.isfinite(box.size).all() and min(box.size) > 0):
        raise LogError(
            f"{box.where}: the box of {box.key!r} needs a positive length, width and height, not "
            f"{list(box.size)}"
        )
    if not np.isfinite(box.T_world_object).all():
        raise LogError(f"{box.where}: the pose of {box.key!r} is not finite")


def _trajectory(key: str, members: list[FrameBox]) -> Trajectory:
    times_us = [b.time_us for b in members]
    for one, two in pairwise(members):
        if one.time_us == two.time_us:
            raise LogError(f"{two.where}: {key!r} has two boxes at {one.time_us} us")
    try:
        return Trajectory.from_transforms(
            np.array(times_us, dtype=np.int64), np.array([b.T_world_object for b in members])
        )
    except SceneError as error:
        raise LogError(f"{members[0].where}: {key!r}: {error}") from error
