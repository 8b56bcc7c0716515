"""Log readers, one module per dataset layout."""

from .argoverse2 import Argoverse2Reader
from .kitti import KittiReader
from .native import NativeReader
from .reader import LogReader
from .waymo_v1 import WaymoV1Reader
from .waymo_v2 import WaymoV2Reader

READERS: tuple[LogReader, ...] = (
    NativeReader(),
    KittiReader(),
    WaymoV2Reader(),
    WaymoV1Reader(),
    Argoverse2Reader(),
)
"""All known readers; the first that recognises a folder reads it."""

__all__ = [
    "READERS",
    "Argoverse2Reader",
    "KittiReader",
    "LogReader",
    "NativeReader",
    "WaymoV1Reader",
    "WaymoV2Reader",
]
