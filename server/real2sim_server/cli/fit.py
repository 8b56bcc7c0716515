"""``real2sim fit-lidar`` and ``fit-uncertainty``: fit properties of a scene to its log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..console import print_figures, staged_progress, write_json
from .command import command
from .options import (
    JsonFile,
    LogFormat,
    RenderBackend,
    RenderDevice,
    SceneBundle,
    Sequence,
    chosen_backend,
)

if TYPE_CHECKING:
    from ..logs import DrivingLog
    from ..scene import Scene


Fitted = tuple["Scene", dict[str, Any]]
"""The scene with what was fitted, and figures of the fit."""


@dataclass(frozen=True)
class FitFiles:
    """What is read and written.

    Attributes:
        scene: bundle.
        log: folder of the driving log.
        out: bundle to write; None for the scene itself.
        log_format, sequence: of the log, where its folder does not tell.
        json: file for the figures.
    """

    scene: Path
    log: Path
    out: Path | None
    log_format: str | None
    sequence: str | None
    json: Path | None


def fit_scene(
    files: FitFiles, what: str, fit: Callable[[Scene, DrivingLog, Callable[..., None]], Fitted]
) -> None:
    """Fit ``what`` of a scene, write the bundle and print the figures."""
    from ..logs import open_log, same_part
    from ..scene.io import load_scene, save_scene

    scene = load_scene(files.scene)
    opened = open_log(files.log, format=files.log_format, sequence=files.sequence)
    log = same_part(opened, scene.provenance)
    with staged_progress() as on_progress:
        made, fitted = fit(scene, log, on_progress)
    target = files.scene if files.out is None else files.out
    save_scene(made, target, overwrite=files.out is None)
    figures = {"scene": str(target), **fitted}
    print_figures(f"{target.name}, {what}", figures)
    write_json(files.json, figures)


# ``real2sim fit-lidar``: what LiDARs see of a scene, from the sweeps of its log.


@command("fit-lidar")
def fit_lidar(
    *,
    scene: SceneBundle,
    log: Annotated[Path, typer.Argument(help="Folder of the scene's driving log.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output bundle; default: the scene itself.")
    ] = None,
    surfaces: Annotated[
        Path | None,
        typer.Option(help="initial.r2s of the training folder, to save time."),
    ] = None,
    steps: Annotated[
        int, typer.Option(min=0, help="Training steps, about one core second each.")
    ] = 60,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Fit LiDAR surfaces and reflectivity of a scene to the recorded sweeps."""
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


# ``real2sim fit-uncertainty``: how well the images of a log tell what a scene shows.


@command("fit-uncertainty")
def fit_uncertainty(
    *,
    scene: SceneBundle,
    log: Annotated[Path, typer.Argument(help="Folder of the scene's driving log.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output bundle; default: the scene itself.")
    ] = None,
    views: Annotated[
        int, typer.Option(min=1, max=10_000, help="Number of images to compare.")
    ] = 48,
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Add uncertainty to a scene, as training does for new scenes."""
    from dataclasses import asdict

    from ..reconstruct.evaluation.uncertainty import fit_uncertainties

    def fit(loaded: Scene, opened: DrivingLog, on_progress: Callable[..., None]) -> Fitted:
        made, report = fit_uncertainties(
            loaded,
            opened,
            views=views,
            backend=chosen_backend(backend, device),
            on_view=lambda done, total: on_progress("views", done, total),
        )
        return made, asdict(report)

    fit_scene(FitFiles(scene, log, out, log_format, sequence, json), "uncertainty", fit)
