"""Maps of other programs as lane graphs, one reader a format; what fits none is refused by name."""

from .errors import MapError
from .opendrive import OpenDriveReader
from .read import MAP_READERS, read_map, register_map_reader
from .reader import MapReader

__all__ = [
    "MAP_READERS",
    "MapError",
    "MapReader",
    "OpenDriveReader",
    "read_map",
    "register_map_reader",
]
