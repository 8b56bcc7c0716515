"""``real2sim fit-uncertainty``: how well the images of a log tell what a scene shows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import print_figures, staged_progress, write_json
from .command import command
from .device import chosen_backend
from .options import JsonFile, LogFormat, RenderBackend, RenderDevice, SceneBundle, Sequence


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

    from ..logs import open_log, same_part
    from ..reconstruct.uncertainty import fit_uncertainties
    from ..scene.io import load_scene, save_scene

    loaded = load_scene(scene)
    opened = same_part(open_log(log, format=log_format, sequence=sequence), loaded.provenance)
    with staged_progress() as on_progress:
        made, report = fit_uncertainties(
            loaded,
            opened,
            views=views,
            backend=chosen_backend(backend, device),
            on_view=lambda done, total: on_progress("views", done, total),
        )
    target = scene if out is None else out
    save_scene(made, target, overwrite=out is None)
    figures: dict[str, object] = {"scene": str(target), **asdict(report)}
    print_figures(f"{target.name}, uncertainty", figures)
    write_json(json, figures)
