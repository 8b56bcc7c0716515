"""``real2sim import``: a splat file becomes a scene or an asset."""

from __future__ import annotations

from pathlib import Path

from ..console import CommandError, print_figures, refuse_existing, write_json
from ..scene.io import import_splats, save_asset, save_scene

UP_AXES = ("z", "y", "-y")


def run(
    *,
    file: Path,
    out: Path,
    category: str | None,
    up_axis: str,
    overwrite: bool,
    json_path: Path | None,
) -> None:
    """Read ``file`` and write a scene bundle, or an asset of ``category`` where it is given."""
    refuse_existing(out, overwrite=overwrite)
    if up_axis not in UP_AXES:
        raise CommandError(f"--up-axis {up_axis!r}; allowed are {', '.join(UP_AXES)}")
    figures: dict[str, object]
    if category is None:
        scene = import_splats(file, name=out.name, up_axis=up_axis)
        scene = save_scene(scene, out, overwrite=overwrite)
        figures = {
            "scene": str(out),
            "gaussians": scene.gaussian_count,
            "content_hash": scene.content_hash,
        }
    else:
        asset = import_splats(
            file, name=out.name, as_asset=True, category=category, up_axis=up_axis
        )
        asset = save_asset(asset, out, overwrite=overwrite)
        figures = {
            "asset": str(out),
            "gaussians": len(asset.cloud),
            "size_m": " x ".join(f"{edge:.2f}" for edge in asset.size),
            "content_hash": asset.content_hash,
        }
    print_figures(f"imported {file.name}", figures)
    write_json(json_path, figures)
