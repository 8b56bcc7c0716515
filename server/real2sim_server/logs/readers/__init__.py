"""Log readers, one module per dataset layout."""

from .argoverse2 import Argoverse2Reader
from .common import LogReader
from .drivestudio import DrivestudioReader
from .kitti_raw import KittiRawReader
from .kitti_tracking import KittiReader
from .native import NativeReader
from .nuscenes import NuScenesReader
from .street_gaussians import StreetGaussiansReader
from .waymo_v1 import WaymoV1Reader
from .waymo_v2 import WaymoV2Reader

READERS: list[LogReader] = [
    NativeReader(),
    KittiReader(),
    KittiRawReader(),
    WaymoV2Reader(),
    WaymoV1Reader(),
    Argoverse2Reader(),
    NuScenesReader(),
    StreetGaussiansReader(),
    DrivestudioReader(),
]
"""All registered readers; the first that recognises a folder reads it."""


def register_reader(reader: LogReader) -> None:
    """Register a reader from outside this package for ``open_log``.

    Args:
        reader: reader of a layout that no other reader recognises.

    Raises:
        ValueError: a reader with that name is registered.
    """
    if any(known.name == reader.name for known in READERS):
        raise ValueError(f"a log reader named {reader.name!r} is registered already")
    READERS.append(reader)


__all__ = ["READERS", "LogReader", "register_reader"]
