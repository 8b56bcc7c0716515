"""Scenes, assets and splats on disk."""

from .bundle import load_asset, load_scene, save_asset, save_scene
from .export import export_scene
from .packed import read_packed, write_packed
from .splats import import_splats, read_splats, write_ply, write_splats
from .summary import ObjectSummary, SceneSummary, read_scene_summary

__all__ = [
    "ObjectSummary",
    "SceneSummary",
    "export_scene",
    "import_splats",
    "load_asset",
    "load_scene",
    "read_packed",
    "read_scene_summary",
    "read_splats",
    "save_asset",
    "save_scene",
    "write_packed",
    "write_ply",
    "write_splats",
]
