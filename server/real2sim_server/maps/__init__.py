"""Maps of other programs as lane graphs, with one reader per format.

Unsupported content is rejected by name.
"""

from .align import Alignment, align, driven_poses, laid_on
from .from_log import LANE_SOURCES, LaneSource, lanes_from_log, lanes_of_log
from .opendrive import OpenDriveReader
from .read import MAP_READERS, read_map, register_map_reader
from .reader import MapError, MapReader

__all__ = [
    "LANE_SOURCES",
    "MAP_READERS",
    "Alignment",
    "LaneSource",
    "MapError",
    "MapReader",
    "OpenDriveReader",
    "align",
    "driven_poses",
    "laid_on",
    "lanes_from_log",
    "lanes_of_log",
    "read_map",
    "register_map_reader",
]
