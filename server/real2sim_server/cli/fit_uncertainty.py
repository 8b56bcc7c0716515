"""``real2sim fit-uncertainty``: how well the images of a log tell what a scene shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .command import command
from .device import chosen_backend
from .fit import FitFiles, Fitted, fit_scene
from .options import JsonFile, LogFormat, RenderBackend, RenderDevice, SceneBundle, Sequence

if TYPE_CHECKING:
    from ..logs import DrivingLog
    from ..scene import Scene


@command("fit-uncertainty")
def fit_uncertainty(
    *,
    scene: SceneBundle,
    log: Annotated[Path, typer.Argument(help="Folder of the driving log it was made of.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Bundle to write; the scene itself.")
    ] = None,
    views: Annotated[int, typer.Option(min=1, max=10_000, help="Images to compare.")] = 48,
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Give a scene images of its uncertainty, as training does with new ones."""
    from dataclasses import asdict

    from ..reconstruct.uncertainty import fit_uncertainties

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
