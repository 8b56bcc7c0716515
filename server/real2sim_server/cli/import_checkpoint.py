"""``real2sim import`` of a checkpoint that another system has trained."""

from __future__ import annotations

from pathlib import Path

from ..console import errors, print_figures, refuse_existing, write_json
from ..reconstruct.imports import CheckpointOptions, import_checkpoint
from ..scene.io import save_scene


def run(
    *,
    file: Path,
    out: Path,
    dataset: Path | None,
    frames: tuple[int, int] | None,
    overwrite: bool,
    json_path: Path | None,
) -> None:
    """Read a Street Gaussians or drivestudio checkpoint and write a scene bundle."""
    refuse_existing(out, overwrite=overwrite)
    first, last = frames or (0, None)
    options = CheckpointOptions(dataset=dataset, first_frame=first, last_frame=last, name=out.name)
    imported = import_checkpoint(file, options)
    for warning in imported.warnings:
        errors.print(f"[yellow]warning:[/] {warning}", highlight=False, soft_wrap=True)
    scene = save_scene(imported.scene, out, overwrite=overwrite)
    figures = {
        "scene": str(out),
        "objects": len(scene.objects),
        "gaussians": scene.gaussian_count,
        "content_hash": scene.content_hash,
        "warnings": list(imported.warnings),
    }
    print_figures(f"imported {file.name}", figures)
    write_json(json_path, figures)
