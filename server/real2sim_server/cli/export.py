"""``real2sim export``: a scene for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import print_figures, refuse_existing, write_json
from .command import command
from .options import JsonFile, Overwrite, SceneBundle

if TYPE_CHECKING:
    from ..scene import Scene


@command("export")
def export(
    *,
    scene: SceneBundle,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Output file, or folder with one file per object.")
    ],
    file_format: Annotated[
        str,
        typer.Option("--format", help="Format: ply, compressed.ply, spz, splat, gltf or points."),
    ] = "ply",
    t_us: Annotated[
        int | None, typer.Option(help="Bake the whole scene at this time [us] into one file.")
    ] = None,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="Export only this object; repeatable.")
    ] = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Write a scene for other programs: per object, baked at a time, animated as glTF, or as
    plain points: all in one .ply, or in a folder the background and each object apart."""
    from ..scene.io import export_scene, load_scene
    from ..scene.io.splats import FORMATS

    refuse_existing(out, overwrite=overwrite)
    loaded = load_scene(scene)
    if file_format == "points":
        files = _write_points(loaded, out, t_us, objects)
        _tell(scene, loaded.gaussian_count, files, "z", json)
        return
    # export_scene itself refuses formats and objects that it does not know, with those there are.
    files = export_scene(loaded, out, format=file_format, t_us=t_us, objects=objects or None)
    axes = {"gltf": "y"} | {known.suffix[1:]: known.up_axis for known in FORMATS}
    _tell(scene, loaded.gaussian_count, files, axes[file_format], json)


def _write_points(
    scene: Scene, out: Path, t_us: int | None, objects: list[str] | None
) -> tuple[Path, ...]:
    import numpy as np

    from .._files import atomic_file, atomic_folder
    from ..edit import ScenarioState
    from ..edit.compose import ply_of_points, points_at

    state, instant = ScenarioState.of(scene), scene.start_us if t_us is None else t_us
    placed = state.tracks.at(instant).objects
    chosen = [scene.object(name).object_id for name in objects or scene.objects]
    shown = [o for o in placed if o.object_id in chosen]
    parts = {"background": points_at(scene, state, instant, part="background")}
    for subject in shown:
        number = subject.instance_id
        parts[subject.object_id] = points_at(scene, state, instant, instance_id=number)
    if out.suffix.lower() == ".ply":
        with atomic_file(out) as file:
            file.writelines(ply_of_points(np.concatenate(list(parts.values()))))
        return (out,)
    with atomic_folder(out) as folder:
        for name, rows in parts.items():
            with atomic_file(folder / f"{name}.ply") as file:
                file.writelines(ply_of_points(rows))
    return tuple(out / f"{name}.ply" for name in parts)


def _tell(
    scene: Path, gaussians: int, files: Sequence[Path], up_axis: str, json: Path | None
) -> None:
    figures: dict[str, object] = {
        "files": [str(file) for file in files],
        "bytes": sum(file.stat().st_size for file in files),
        "gaussians": gaussians,
        "up_axis": up_axis,
    }
    print_figures(f"exported {scene.name}", figures)
    write_json(json, figures)
