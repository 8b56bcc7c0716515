"""Scenes of sweeps, found by name on this machine."""

from __future__ import annotations

import tempfile
from pathlib import Path

from ..console import CommandError
from ..demo.street import unpack_street
from ..scene import Scene
from ..scene.io import DEMO_SCENE, load_scene


def open_scene(name: str, folder: Path | None = None) -> Scene:
    """The bundle of that path, or of that name below a folder; the demo's street without one.

    Raises:
        CommandError: there is none.
        BundleError: it cannot be read.
    """
    places = [Path(name), *([folder / name] if folder is not None else [])]
    for place in places:
        if place.is_dir():
            return load_scene(place)
    if name == DEMO_SCENE:
        # As a bundle, whose hash recordings name: the demo's worker has it so too.
        with tempfile.TemporaryDirectory(prefix="real2sim-street-") as made:
            unpack_street(Path(made), DEMO_SCENE)
            return load_scene(Path(made) / DEMO_SCENE)
    raise CommandError(
        f"no scene {name!r}; give the path of a bundle, its name below the folder of --scenes, or "
        f"{DEMO_SCENE}"
    )
