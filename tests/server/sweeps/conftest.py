from __future__ import annotations

from pathlib import Path

import pytest

from real2sim_server.scene.io import save_scene


@pytest.fixture(scope="session")
def scene_folder(tiny_scene, tmp_path_factory) -> Path:
    """Bundles for sweeps: the small street as ``tiny``."""
    folder = tmp_path_factory.mktemp("sweep_scenes")
    save_scene(tiny_scene, folder / "tiny")
    return folder
