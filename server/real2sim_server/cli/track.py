"""``real2sim track``: give a log without boxes the tracks of what moves in its LiDAR."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ..console import CommandError, console, print_figures, progress, refuse_existing, write_json
from ..logs import ObjectTrack, inspect_log
from ..logs.native_writer import write_native_log
from ..logs.open import open_log
from ..logs.tracking import TrackingOptions, track_moving_objects


def run(
    *,
    log: Path,
    out: Path,
    options: Mapping[str, Any],
    keep: bool,
    image_format: str,
    log_format: str | None,
    sequence: str | None,
    json_path: Path | None,
) -> None:
    """Track moving objects in ``log`` and write it with their boxes to the folder ``out``.

    Args:
        options: fields of TrackingOptions that differ from the defaults.
        keep: keep the boxes that the log has and add only objects that it has none for.
    """
    refuse_existing(out, overwrite=False)
    opened = open_log(log, format=log_format, sequence=sequence)
    start = time.perf_counter()
    with progress("tracking") as report:
        found = track_moving_objects(opened, TrackingOptions(**options), on_progress=report)
    if not found:
        raise CommandError(
            f"nothing that moves was found in the LiDAR of {log}; a lower --least-distance or "
            "--least-frames finds more"
        )
    tracked = replace(opened, tracks=merged(opened.tracks if keep else (), found))
    with progress("writing the log") as report:
        write_native_log(tracked, out, image_format=image_format, on_progress=report)
    inspect_log(tracked, out / "pictures")
    figures = {
        "log": str(out),
        "tracks": {track.object_id: _told(track) for track in tracked.tracks},
        "pictures": str(out / "pictures"),
        "seconds": time.perf_counter() - start,
    }
    print_figures("moving objects", figures)
    console.print(f"next: real2sim reconstruct {out} --out out/scenes/{out.name}")
    write_json(json_path, figures)


def merged(given: Sequence[ObjectTrack], found: Sequence[ObjectTrack]) -> tuple[ObjectTrack, ...]:
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
    times = np.linspace(first, last, 9).astype(np.int64)
    for t_us in times:
        T_other_world = np.linalg.inv(other.trajectory.transform(int(t_us)))
        centre = T_other_world @ track.trajectory.transform(int(t_us))[:, 3]
        inside += bool((np.abs(centre[:3]) <= np.array(other.size) / 2).all())
    return 2 * inside >= len(times)


def _told(track: ObjectTrack) -> str:
    path = track.trajectory
    length, width, height = track.size
    way = np.linalg.norm(np.diff(path.positions, axis=0), axis=1).sum()
    seconds = (path.end_us - path.start_us) / 1e6
    return f"{length:.1f} x {width:.1f} x {height:.1f} m, {way:.1f} m in {seconds:.1f} s"
