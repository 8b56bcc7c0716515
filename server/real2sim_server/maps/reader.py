"""What a reader of maps is."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from ..scene.lane_graph import LaneGraph


class MapReader(Protocol):
    """Reads one format of maps.

    Attributes:
        name: of the format, as given to ``read_map(format=...)``.
        expects: one line for users, what the file or folder must be.
    """

    name: str
    expects: str

    def recognises(self, path: Path) -> bool:
        """Whether the file or folder looks like this format; cheap, and never raises."""
        ...

    def read(self, path: Path) -> LaneGraph:
        """The map at ``path``, in the map's own frame [m]: x and y seen from above, z up.

        Raises:
            MapError: names the file, what is wrong and what is expected.
        """
        ...
