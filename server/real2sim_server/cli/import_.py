"""``real2sim import``: splats or a checkpoint of another system become a scene or an asset."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, cast, get_args

import typer

from ..console import CommandError, errors, print_figures, refuse_existing, write_json
from .command import command
from .options import JsonFile, Overwrite

UpAxis = Literal["z", "y", "-y"]
CHECKPOINT_SUFFIX = ".pth"


@command("import")
def import_(
    *,
    file: Annotated[
        Path,
        typer.Argument(
            help="Splats (.ply, .compressed.ply, .spz, .splat) or a checkpoint (.pth) of Street "
            "Gaussians or drivestudio."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Bundle to write.")],
    asset: Annotated[
        bool, typer.Option("--asset", help="Import an asset instead of a scene.")
    ] = False,
    category: Annotated[str, typer.Option(help="Category of the asset.")] = "car",
    up_axis: Annotated[
        str | None,
        typer.Option(
            help="Axis that points up in the file: z, y or -y; default: what the file says (y for "
            "spz), else z."
        ),
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="Training data folder of a checkpoint.")
    ] = None,
    frames: Annotated[
        tuple[int, int] | None, typer.Option(help="First and last frame of a checkpoint.")
    ] = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Turn a splat file or a checkpoint of another system into a scene, or splats into an asset."""
    refuse_existing(out, overwrite=overwrite)
    if file.suffix == CHECKPOINT_SUFFIX:
        figures = _import_checkpoint(file, out, dataset, frames, overwrite=overwrite)
    elif up_axis not in (None, *get_args(UpAxis)):
        raise CommandError(f"--up-axis {up_axis!r}; allowed are {', '.join(get_args(UpAxis))}")
    elif asset:
        figures = _import_asset(
            file, out, category, cast("UpAxis | None", up_axis), overwrite=overwrite
        )
    else:
        figures = _import_scene(file, out, cast("UpAxis | None", up_axis), overwrite=overwrite)
    print_figures(f"imported {file.name}", figures)
    write_json(json, figures)


def _import_checkpoint(
    file: Path,
    out: Path,
    dataset: Path | None,
    frames: tuple[int, int] | None,
    *,
    overwrite: bool,
) -> dict[str, object]:
    from ..reconstruct.imports import CheckpointOptions, import_checkpoint
    from ..scene.io import save_scene

    first, last = frames or (0, None)
    options = CheckpointOptions(dataset=dataset, first_frame=first, last_frame=last, name=out.name)
    imported = import_checkpoint(file, options)
    for warning in imported.warnings:
        errors.print(f"[yellow]warning:[/] {warning}", highlight=False, soft_wrap=True)
    scene = save_scene(imported.scene, out, overwrite=overwrite)
    return {
        "scene": str(out),
        "objects": len(scene.objects),
        "gaussians": scene.gaussian_count,
        "content_hash": scene.content_hash,
        "warnings": list(imported.warnings),
    }


def _import_asset(
    file: Path, out: Path, category: str, up_axis: UpAxis | None, *, overwrite: bool
) -> dict[str, object]:
    from ..scene.io import import_splats, save_asset

    asset = import_splats(file, name=out.name, as_asset=True, category=category, up_axis=up_axis)
    asset = save_asset(asset, out, overwrite=overwrite)
    return {
        "asset": str(out),
        "up_axis": asset.provenance["up_axis"],
        "gaussians": len(asset.cloud),
        "size_m": " x ".join(f"{edge:.2f}" for edge in asset.size),
        "content_hash": asset.content_hash,
    }


def _import_scene(
    file: Path, out: Path, up_axis: UpAxis | None, *, overwrite: bool
) -> dict[str, object]:
    from ..scene.io import import_splats, save_scene

    scene = import_splats(file, name=out.name, up_axis=up_axis)
    scene = save_scene(scene, out, overwrite=overwrite)
    return {
        "scene": str(out),
        "up_axis": scene.provenance["up_axis"],
        "gaussians": scene.gaussian_count,
        "content_hash": scene.content_hash,
    }
