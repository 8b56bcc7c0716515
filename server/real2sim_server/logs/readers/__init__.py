"""Log readers, one module per dataset layout."""

from .argoverse2 import Argoverse2Reader
from .drivestudio import DrivestudioReader
from .kitti.raw import KittiRawReader
from .kitti.tracking import KittiReader
from .native import NativeReader
from .nuscenes import NuScenesReader
from .reader import LogReader
from .street_gaussians import StreetGaussiansReader
from .waymo.v1 import WaymoV1Reader
from .waymo.v2 import WaymoV2Reader

READERS: tuple[LogReader, ...] = (
    NativeReader(),
    KittiReader(),
    KittiRawReader(),
    WaymoV2Reader(),
    WaymoV1Reader(),
    Argoverse2Reader(),
    NuScenesReader(),
    StreetGaussiansReader(),
    DrivestudioReader(),
)
"""All known readers; the first that recognises a folder reads it."""

__all__ = [
    "READERS",
    "Argoverse2Reader",
    "DrivestudioReader",
    "KittiRawReader",
    "KittiReader",
    "LogReader",
    "NativeReader",
    "NuScenesReader",
    "StreetGaussiansReader",
    "WaymoV1Reader",
    "WaymoV2Reader",
]
