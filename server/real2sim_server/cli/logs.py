"""Log commands: synth, log-info and track."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, print_figures, progress, refuse_existing, write_json
from .common import DrivingLogPath, JsonFile, LogFormat, SequenceName, Strict, command, opened_log

if TYPE_CHECKING:
    from ..logs import ObjectTrack


# --- synth ----------------------------------------------------------------------------------------


@command("synth")
def synth(
    *,
    out: Annotated[Path, typer.Option("--out", help="Output folder.")],
    frames: Annotated[int, typer.Option(min=2, max=10_000, help="Number of frames.")] = 60,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the street.")] = 0,
    width: Annotated[int, typer.Option(min=32, max=4096, help="Image width [px].")] = 480,
    height: Annotated[int, typer.Option(min=32, max=4096, help="Image height [px].")] = 320,
    moving_cars: Annotated[int, typer.Option(min=0, max=40, help="Number of moving cars.")] = 4,
    parked_cars: Annotated[int, typer.Option(min=0, max=80, help="Number of parked cars.")] = 14,
    pedestrians: Annotated[int, typer.Option(min=0, max=60, help="Number of pedestrians.")] = 0,
    cyclists: Annotated[int, typer.Option(min=0, max=20, help="Number of cyclists.")] = 0,
    json: JsonFile = None,
) -> None:
    """Generate a log of a procedural street: cameras, LiDAR, exact poses and boxes."""
    from ..logs.open import open_log
    from ..synthetic import SyntheticConfig, synthesize

    refuse_existing(out, overwrite=False)
    try:
        config = SyntheticConfig(
            frames=frames,
            seed=seed,
            width=width,
            height=height,
            moving_cars=moving_cars,
            parked_cars=parked_cars,
            pedestrians=pedestrians,
            cyclists=cyclists,
        )
    except ValueError as error:
        raise CommandError(str(error)) from error
    start = time.perf_counter()
    with progress("casting rays") as report:
        synthesize(config, out, on_progress=report)
    log = open_log(out)
    figures = {
        "log": str(out),
        "frames": log.frame_count,
        "cameras": len(log.rig),
        "tracks": len(log.tracks),
        "seconds": time.perf_counter() - start,
    }
    print_figures("synthetic log", figures)
    console.print(f"next: real2sim reconstruct {out} --out out/scenes/{out.name}")
    write_json(json, figures)


# --- log-info -------------------------------------------------------------------------------------


@command("log-info")
def log_info(
    *,
    log: DrivingLogPath,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for pictures with boxes and LiDAR.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Read all images and sweeps, not only their headers.")
    ] = False,
    strict: Strict = False,
    log_format: LogFormat = None,
    sequence: SequenceName = None,
    json: JsonFile = None,
) -> None:
    """Summarise a log, say what of it cannot be used, draw its boxes and LiDAR.

    The exit code is 1 if it cannot be reconstructed.
    """
    from ..logs import inspect_log
    from ..logs.check import check_log, leave_out, problems_of
    from ..logs.open import open_log

    opened, checked = open_log(log, format=log_format, sequence=sequence), None
    if check:
        with progress("checking files") as on_progress:
            checked = check_log(opened, on_progress=on_progress)
        opened = leave_out(opened, checked)
    report = inspect_log(opened, out)
    problems = [*report.problems, *problems_of(opened, strict=strict)]
    lines = report.lines()
    if checked is not None:
        lines.append(f"checked   {checked.images} images and {checked.sweeps} sweeps read")
        lines += [] if problems or opened.left_out else ["no problems found"]
    lines += [f"problem   {text}" for text in problems]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    write_json(json, {**report.as_json(), "problems": problems})
    if problems:
        raise typer.Exit(1)


# --- track ----------------------------------------------------------------------------------------


@command("track")
def track(
    *,
    log: DrivingLogPath,
    out: Annotated[Path, typer.Option("--out", help="Output folder of the log with boxes.")],
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep the log's own boxes and add missing ones.")
    ] = False,
    reach: Annotated[
        float, typer.Option(min=5, max=200, help="Maximum distance from the vehicle [m].")
    ] = 55.0,
    min_distance: Annotated[
        float, typer.Option(min=0.1, help="Minimum distance that an object travels [m].")
    ] = 1.5,
    min_frames: Annotated[int, typer.Option(min=2, help="Minimum frames in which it is seen.")] = 6,
    images: Annotated[
        str, typer.Option(help="Image format: png (lossless) or jpg (smaller).")
    ] = "jpg",
    log_format: LogFormat = None,
    sequence: SequenceName = None,
    json: JsonFile = None,
) -> None:
    """Detect and track moving objects in the LiDAR of a log without boxes."""
    from ..logs import inspect_log
    from ..logs.readers.native import write_native_log
    from ..logs.tracking import TrackingOptions, merge_tracks, track_moving_objects

    refuse_existing(out, overwrite=False)
    opened = opened_log(log, log_format, sequence)
    options = TrackingOptions(reach=reach, min_distance=min_distance, min_frames=min_frames)
    start = time.perf_counter()
    with progress("tracking") as report:
        found = track_moving_objects(opened, options, on_progress=report)
    if not found and not any(len(opened.lidar(f).points) for f in range(opened.frame_count)):
        raise CommandError(f"{log} has no LiDAR; track finds objects in LiDAR only")
    if not found:
        raise CommandError(
            f"nothing that moves was found in the LiDAR of {log}; a lower --min-distance or "
            "--min-frames finds more"
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
