"""``real2sim synth``: write a synthetic driving log."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from ..console import CommandError, console, print_figures, progress, refuse_existing, write_json
from .command import command
from .options import JsonFile


@command("synth")
def synth(
    *,
    out: Annotated[Path, typer.Option("--out", help="Output folder.")],
    frames: Annotated[int, typer.Option(min=2, max=10_000)] = 60,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    width: Annotated[int, typer.Option(min=32, max=4096, help="Image width [px].")] = 480,
    height: Annotated[int, typer.Option(min=32, max=4096, help="Image height [px].")] = 320,
    moving_cars: Annotated[int, typer.Option(min=0, max=40)] = 4,
    parked_cars: Annotated[int, typer.Option(min=0, max=80)] = 14,
    pedestrians: Annotated[int, typer.Option(min=0, max=60, help="Number of pedestrians.")] = 0,
    cyclists: Annotated[int, typer.Option(min=0, max=20)] = 0,
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
