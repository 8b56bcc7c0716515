"""Commands about driving logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import JsonFile, LogFormat, Sequence, app, run_command


@app.command()
def synth(
    out: Annotated[Path, typer.Option("--out", help="Folder of the log to write.")],
    frames: Annotated[int, typer.Option(min=2, max=10_000)] = 60,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    width: Annotated[int, typer.Option(min=32, max=4096, help="Image width [px].")] = 480,
    height: Annotated[int, typer.Option(min=32, max=4096, help="Image height [px].")] = 320,
    moving_cars: Annotated[int, typer.Option(min=0, max=40)] = 4,
    parked_cars: Annotated[int, typer.Option(min=0, max=80)] = 14,
    json: JsonFile = None,
) -> None:
    """Generate a driving log of a procedural street: cameras, LiDAR, exact poses and boxes."""
    from . import synth as command

    run_command(
        command.run,
        out=out,
        sizes={"frames": frames, "seed": seed, "width": width, "height": height},
        cars={"moving_cars": moving_cars, "parked_cars": parked_cars},
        json_path=json,
    )


@app.command("log-info")
def log_info(
    log: Annotated[Path, typer.Argument(help="Folder of a driving log.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for pictures with boxes and LiDAR.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Look at every file, as training does first.")
    ] = False,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Say what a log holds, and draw its boxes and LiDAR on its images."""
    from . import log_info as command

    run_command(
        command.run,
        log=log,
        out=out,
        log_format=log_format,
        sequence=sequence,
        check=check,
        json_path=json,
    )


@app.command()
def track(
    log: Annotated[Path, typer.Argument(help="Folder of a driving log with LiDAR.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the log to write, with boxes.")],
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep the log's own boxes and add what they lack.")
    ] = False,
    reach: Annotated[
        float, typer.Option(min=5, max=200, help="How far from the vehicle to look [m].")
    ] = 55.0,
    least_distance: Annotated[
        float, typer.Option(min=0.1, help="How far an object must go [m].")
    ] = 1.5,
    least_frames: Annotated[int, typer.Option(min=2, help="In how many frames it is seen.")] = 6,
    images: Annotated[str, typer.Option(help="png (exact) or jpg (smaller).")] = "jpg",
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Find what moves in the LiDAR of a log without boxes, and write the log with them."""
    from . import track as command

    run_command(
        command.run,
        log=log,
        out=out,
        options={"reach": reach, "least_distance": least_distance, "least_frames": least_frames},
        keep=keep,
        image_format=images,
        log_format=log_format,
        sequence=sequence,
        json_path=json,
    )
