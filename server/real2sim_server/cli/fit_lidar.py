"""``real2sim fit-lidar``: what LiDARs see of a scene, from the sweeps of its log."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .command import command
from .fit import FitFiles, Fitted, fit_scene
from .options import JsonFile, LogFormat, SceneBundle, Sequence

if TYPE_CHECKING:
    from ..logs import DrivingLog
    from ..scene import Scene


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

    from ..reconstruct.lidar import fit_lidar_surfaces
    from ..scene.io import load_scene

    def fit(loaded: Scene, opened: DrivingLog, on_progress: Callable[..., None]) -> Fitted:
        made, report = fit_lidar_surfaces(
            loaded,
            opened,
            surfaces=load_scene(surfaces) if surfaces else None,
            steps=steps,
            on_progress=on_progress,
        )
        figures = asdict(report)
        del figures["timing_s"]
        return made, figures

    fit_scene(FitFiles(scene, log, out, log_format, sequence, json), "surfaces for LiDARs", fit)
