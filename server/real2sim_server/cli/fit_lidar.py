"""``real2sim fit-lidar``: what LiDARs see of a scene, from the sweeps of its log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import print_figures, staged_progress, write_json
from .command import command
from .options import JsonFile, LogFormat, SceneBundle, Sequence


@command("fit-lidar")
def fit_lidar(
    *,
    scene: SceneBundle,
    log: Annotated[Path, typer.Argument(help="Folder of the driving log it was made of.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Bundle to write; the scene itself.")
    ] = None,
    surfaces: Annotated[
        Path | None,
        typer.Option(help="initial.r2s of its training folder, which spares making it again."),
    ] = None,
    steps: Annotated[
        int, typer.Option(min=0, help="Steps of learning; about a second of one core each.")
    ] = 60,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Give a scene surfaces for LiDARs, learned from the recorded sweeps, with reflectivity."""
    from dataclasses import asdict

    from ..logs import open_log, same_part
    from ..reconstruct.lidar import fit_lidar_surfaces
    from ..scene.io import load_scene, save_scene

    loaded = load_scene(scene)
    opened = same_part(open_log(log, format=log_format, sequence=sequence), loaded.provenance)
    with staged_progress() as on_progress:
        made, report = fit_lidar_surfaces(
            loaded,
            opened,
            surfaces=load_scene(surfaces) if surfaces else None,
            steps=steps,
            on_progress=on_progress,
        )
    target = scene if out is None else out
    save_scene(made, target, overwrite=out is None)
    figures: dict[str, object] = {"scene": str(target), **asdict(report)}
    figures.pop("timing_s")
    print_figures(f"{target.name}, surfaces for LiDARs", figures)
    write_json(json, figures)
