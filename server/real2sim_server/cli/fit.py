"""What the commands do alike that fit something of a scene to the log it was made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..console import print_figures, staged_progress, write_json

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
