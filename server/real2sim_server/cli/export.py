"""``real2sim export``: a scene for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import print_figures, refuse_existing, write_json
from .command import command
from .options import JsonFile, Overwrite, SceneBundle


@command("export")
def export(
    *,
    scene: SceneBundle,
    out: Annotated[Path, typer.Option("--out", "-o", help="File, or folder of one per object.")],
    file_format: Annotated[
        str, typer.Option("--format", help="ply, compressed.ply, spz, splat or gltf")
    ] = "ply",
    t_us: Annotated[
        int | None, typer.Option(help="Bake everything at this time into one file [us].")
    ] = None,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="Only these objects; repeat it.")
    ] = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Write a scene for other programs: per object, baked at a time, or animated as glTF."""
    from ..scene.io import export_scene, load_scene

    refuse_existing(out, overwrite=overwrite)
    loaded = load_scene(scene)
    # export_scene itself refuses formats and objects that it does not know, with those there are.
    files = export_scene(loaded, out, format=file_format, t_us=t_us, objects=objects or None)
    figures: dict[str, object] = {
        "files": [str(file) for file in files],
        "bytes": sum(file.stat().st_size for file in files),
        "gaussians": loaded.gaussian_count,
    }
    print_figures(f"exported {scene.name}", figures)
    write_json(json, figures)
