"""All map readers, and the function that selects one."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from ..scene.errors import SceneError
from ..scene.io.document import read_lanes
from ..scene.lane_graph import LaneGraph
from .argoverse2 import Argoverse2MapReader
from .lanelet2 import Lanelet2Reader
from .nuscenes import NuScenesMapReader
from .opendrive import OpenDriveReader
from .reader import MapError, MapReader, head_of

# ``lanes.json``: the project's own document of lanes.

NAME = "lanes.json"


class NativeMapReader:
    """Reads the lanes of ``real2sim map --out lanes.json`` or ``GET /v1/scenes/{scene}/lanes``."""

    name = "native"
    expects = "lanes.json, or a folder with it"

    def recognises(self, path: Path) -> bool:
        """Whether the path is a document of lanes, or a folder with ``lanes.json``."""
        if path.is_dir():
            return (path / NAME).is_file()
        return path.suffix.lower() == ".json" and b'"real2sim-lanes"' in head_of(path)

    def read(self, path: Path) -> LaneGraph:
        """The lanes of the document. Raises MapError: see :class:`~.reader.MapReader`."""
        try:
            return read_lanes(path / NAME if path.is_dir() else path)
        except SceneError as error:
            raise MapError(str(error)) from error


MAP_READERS: list[MapReader] = [
    NativeMapReader(),
    OpenDriveReader(),
    Lanelet2Reader(),
    Argoverse2MapReader(),
    NuScenesMapReader(),
]
"""All registered readers; the first that recognises a file reads it."""


def register_map_reader(reader: MapReader) -> None:
    """Register a reader from outside this package for :func:`read_map`.

    Args:
        reader: reader of a format that no other reader recognises.

    Raises:
        ValueError: a reader with that name is registered.
    """
    if any(known.name == reader.name for known in MAP_READERS):
        raise ValueError(f"a map reader named {reader.name!r} is registered already")
    MAP_READERS.append(reader)


def read_map(path: str | PathLike[str], *, format: str | None = None) -> LaneGraph:
    """The lanes of a map, in the map's own frame [m].

    Args:
        path: file, or folder of a data set's map.
        format: name of a reader; None: the first that recognises it.

    Raises:
        MapError: missing, unknown format, or damaged; the message names the file.
    """
    file = Path(path)
    if not file.exists():
        raise MapError(f"{file}: no such file or folder")
    known = {reader.name: reader for reader in MAP_READERS}
    if format is not None and format not in known:
        raise MapError(f"no map format {format!r}; allowed: {', '.join(known)}")
    reader = known[format] if format else _recognised(file)
    try:
        return reader.read(file)
    except SceneError as error:
        raise MapError(f"{file}: {error}") from error


def _recognised(path: Path) -> MapReader:
    for reader in MAP_READERS:
        if reader.recognises(path):
            return reader
    expected = "; ".join(f"{reader.name}: {reader.expects}" for reader in MAP_READERS)
    raise MapError(f"{path}: is not a known map format. Known formats: {expected}")
