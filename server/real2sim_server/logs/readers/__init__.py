"""Log readers, one module per dataset layout."""

from .kitti import KittiReader
from .native import NativeReader
from .reader import LogReader

READERS: tuple[LogReader, ...] = (NativeReader(), KittiReader())
"""All known readers; the first that recognises a folder reads it."""

__all__ = ["READERS", "KittiReader", "LogReader", "NativeReader"]
