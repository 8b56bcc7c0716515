"""``real2sim track``: give a log without boxes the tracks of what moves in its LiDAR."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, print_figures, progress, refuse_existing, write_json
from .command import command
from .options import JsonFile, LogFormat, Sequence

if TYPE_CHECKING:
    from ..logs import ObjectTrack


@command("track")
def track(
    *,
    log: Annotated[Path, typer.Argument(help="Folder of a driving log with LiDAR.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder of the log with boxes.")],
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep the log's own boxes and add missing ones.")
    ] = False,
    reach: Annotated[
        float, typer.Option(min=5, max=200, help="Maximum distance from the vehicle [m].")
    ] = 55.0,
    least_distance: Annotated[
        float, typer.Option(min=0.1, help="Minimum distance that an object travels [m].")
    ] = 1.5,
    least_frames: Annotated[
        int, typer.Option(min=2, help="Minimum frames in which it is seen.")
    ] = 6,
    images: Annotated[
        str, typer.Option(help="Image format: png (lossless) or jpg (smaller).")
    ] = "jpg",
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Detect and track moving objects in a log without boxes."""
    from ..logs import inspect_log
    from ..logs.open import open_log
    from ..logs.readers.native import write_native_log
    from ..logs.tracking import TrackingOptions, merge_tracks, track_moving_objects

    refuse_existing(out, overwrite=False)
    opened = open_log(log, format=log_format, sequence=sequence)
    options = TrackingOptions(reach=reach, least_distance=least_distance, least_frames=least_frames)
    start = time.perf_counter()
    with progress("tracking") as report:
        found = track_moving_objects(opened, options, on_progress=report)
    if not found:
        raise CommandError(
            f"nothing that moves was found in the LiDAR of {log}; a lower --least-distance or "
            "--least-frames finds more"
        )
    tracked = replace(opened, tracks=merge_tracks(opened.tracks if keep else (), found))
    with progress("writing the log") as report:
        write_native_log(tracked, out, image_format=images, on_progress=report)
    inspect_log(tracked, out / "pictures")
    figures = {
        "log": str(out),
        "tracks": {track.object_id: _describe(track) for track in tracked.tracks},
        "pictures": str(out / "pictures"),
        "seconds": time.perf_counter() - start,
    }
    print_figures("moving objects", figures)
    console.print(f"next: real2sim reconstruct {out} --out out/scenes/{out.name}")
    write_json(json, figures)


def _describe(track: ObjectTrack) -> str:
    import numpy as np

    path = track.trajectory
    length, width, height = track.size
    distance = np.linalg.norm(np.diff(path.positions, axis=0), axis=1).sum()
    seconds = (path.end_us - path.start_us) / 1e6
    return f"{length:.1f} x {width:.1f} x {height:.1f} m, {distance:.1f} m in {seconds:.1f} s"
