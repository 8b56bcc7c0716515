"""Tracks that were found, put beside those that a log has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from ..driving_log import ObjectTrack

INSTANTS = 9
"""How many instants of their common time tell whether two tracks are one object's."""


def merge_tracks(
    given: Sequence[ObjectTrack], found: Sequence[ObjectTrack]
) -> tuple[ObjectTrack, ...]:
    """``given``, then those of ``found`` that are none of them, under ids of their own."""
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
    """Whether a track lies in the box of another for half of the time that both are there."""
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
