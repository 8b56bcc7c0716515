"""Test bundles."""

from __future__ import annotations

from pathlib import Path

import pytest

from real2sim_server.scene import Scene
from real2sim_server.scene.io import save_scene


@pytest.fixture
def bundle(scene: Scene, tmp_path: Path) -> Path:
    save_scene(scene, tmp_path / "street.r2s")
    return tmp_path / "street.r2s"
