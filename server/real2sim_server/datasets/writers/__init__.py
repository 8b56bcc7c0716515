"""Writers of public formats, one module each."""

from ..drive import DatasetError
from .argoverse2 import Argoverse2Writer
from .coco import CocoWriter
from .kitti import KittiRawWriter, KittiWriter
from .mcap import McapWriter
from .ncore import NCoreWriter
from .nuscenes import NuScenesWriter
from .plain import LabelsWriter, PicturesWriter, WebDatasetWriter
from .waymo import WaymoWriter
from .writer import DatasetWriter, LabelledDrive

WRITERS: list[DatasetWriter] = [
    LabelsWriter(),
    KittiWriter(),
    KittiRawWriter(),
    CocoWriter(),
    NuScenesWriter(),
    Argoverse2Writer(),
    WaymoWriter(),
    NCoreWriter(),
    WebDatasetWriter(),
    McapWriter(),
    PicturesWriter(),
]
"""All registered writers."""


def writer_names() -> list[str]:
    """Names of the writers in the order of registration."""
    return [writer.name for writer in WRITERS]


def writer_of(name: str) -> DatasetWriter:
    """The writer of that name. Raises DatasetError, which lists the names, if it is unknown."""
    for writer in WRITERS:
        if writer.name == name:
            return writer
    raise DatasetError(f"format {name!r}; allowed are {', '.join(writer_names())}")


def register_writer(writer: DatasetWriter) -> None:
    """Register a writer from outside this package.

    Raises:
        ValueError: a writer with that name is registered.
    """
    if writer.name in writer_names():
        raise ValueError(f"a writer named {writer.name!r} is registered already")
    WRITERS.append(writer)


__all__ = [
    "WRITERS",
    "DatasetWriter",
    "LabelledDrive",
    "register_writer",
    "writer_names",
    "writer_of",
]
