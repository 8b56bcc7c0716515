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
    """Let ``open_log`` know one more reader, from outside of this package.

    Args:
        reader: of a layout that no other reader recognises.

    Raises:
        ValueError: a reader of that name is registered.
    """
    if any(known.name == reader.name for known in READERS):
        raise ValueError(f"a log reader named {reader.name!r} is registered already")
    READERS.append(reader)


__all__ = ["READERS", "LogReader", "register_reader"]
