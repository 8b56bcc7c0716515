"""``real2sim export``: a scene for other programs."""

from __future__ import annotations

from pathlib import Path

from ..console import print_figures, refuse_existing, write_json
from ..scene.io import export_scene, load_scene


def run(
    *,
    scene: Path,
    out: Path,
    file_format: str,
    t_us: int | None,
    objects: list[str] | None,
    overwrite: bool,
    json_path: Path | None,
) -> None:
    """Write the bundle ``scene`` to ``out`` in another format; baked at ``t_us`` where given."""
    refuse_existing(out, overwrite=overwrite)
    loaded = load_scene(scene)
    # export_scene itself refuses formats and objects that it does not know, with those there are.
    files = export_scene(loaded, out, format=file_format, t_us=t_us, objects=objects or None)  # type: ignore[arg-type]
    figures: dict[str, object] = {
        "files": [str(file) for file in files],
        "bytes": sum(file.stat().st_size for file in files),
        "gaussians": loaded.gaussian_count,
    }
    print_figures(f"exported {scene.name}", figures)
    write_json(json_path, figures)
