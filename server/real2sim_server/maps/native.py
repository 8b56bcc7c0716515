"""``lanes.json``: the project's own document of lanes."""

from __future__ import annotations

from pathlib import Path

from ..scene import LaneGraph, SceneError
from ..scene.io.lane_document import read_lanes
from .errors import MapError
from .xml_files import head_of

NAME = "lanes.json"


class NativeMapReader:
    """Reads what ``real2sim map --out lanes.json`` and ``GET /v1/scenes/{scene}/lanes`` write."""

    name = "native"
    expects = "lanes.json, or a folder with it"

    def recognises(self, path: Path) -> bool:
        """Whether it is a document of lanes, or a folder with ``lanes.json``."""
        if path.is_dir():
            return (path / NAME).is_file()
        return path.suffix == ".json" and b'"real2sim-lanes"' in head_of(path)

    def read(self, path: Path) -> LaneGraph:
        """The lanes of the document. Raises MapError: see :class:`~.reader.MapReader`."""
        try:
            return read_lanes(path / NAME if path.is_dir() else path)
        except SceneError as error:
            raise MapError(str(error)) from error
