"""Interface of format writers, and their input."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ...scene import Camera, Ground
from ..clips import Clip


@dataclass(frozen=True, eq=False)
class LabelledDrive:
    """Input of writers.

    Attributes:
        name: name of the data set.
        digest: SHA-256 of its inputs; tokens are derived from it.
        cameras: cameras in order, at the size of the images.
        ego_size: (length, width, height) of the ego [m].
        period_us: time between frames [us].
        clips: clips in order.
        ground: ground of the scene.
        licence: terms of use.
        lidar_position: position of the LiDAR in the ego frame [m].
    """

    name: str
    digest: str
    cameras: tuple[Camera, ...]
    ego_size: tuple[float, float, float]
    period_us: int
    clips: Sequence[Clip]
    ground: Ground
    licence: str
    lidar_position: tuple[float, float, float]

    def token(self, *parts: object) -> str:
        """A token of 32 hexadecimal digits, derived from the export and the given parts."""
        text = "/".join((self.digest, *map(str, parts)))
        return hashlib.sha256(text.encode()).hexdigest()[:32]


class DatasetWriter(Protocol):
    """Writes one format."""

    name: str
    """Name of the format."""

    holds: str
    """Description of the output in one line."""

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """Fill the empty ``folder``. The bytes must only depend on the drive, not on the machine,
        the date or the folder."""
        ...


def write_json(path: Path, content: Any) -> None:
    """Canonical JSON: the same content gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def objects_of(frame: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Objects of a frame by id."""
    return {o["object_id"]: o for o in frame["objects"]}
