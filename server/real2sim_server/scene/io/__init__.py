"""Scenes, assets and splats on disk."""

from .bundle import (
    StagingError,
    StagingLimits,
    load_asset,
    load_scene,
    save_asset,
    save_scene,
    stage_asset,
    stage_scene,
)
from .export import export_scene, import_exported
from .packed import DEMO_SCENE, SHIPPED_STREET, open_scene, read_packed, write_packed
from .splats import import_splats, read_splats, write_splats
from .summary import (
    AssetSummary,
    ObjectSummary,
    SceneSummary,
    read_asset_summary,
    read_scene_summary,
)

__all__ = [
    "DEMO_SCENE",
    "SHIPPED_STREET",
    "AssetSummary",
    "ObjectSummary",
    "SceneSummary",
    "StagingError",
    "StagingLimits",
    "export_scene",
    "import_exported",
    "import_splats",
    "load_asset",
    "load_scene",
    "open_scene",
    "read_asset_summary",
    "read_packed",
    "read_scene_summary",
    "read_splats",
    "save_asset",
    "save_scene",
    "stage_asset",
    "stage_scene",
    "write_packed",
    "write_splats",
]
