"""What a log reader is."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from ..driving_log import DrivingLog


class LogReader(Protocol):
    """Reads one dataset layout.

    Attributes:
        name: the format's name, as given to ``open_log(format=...)``.
        expects: one line for users, what the folder must hold.
    """

    name: str
    expects: str

    def recognises(self, path: Path) -> bool:
        """Whether the folder looks like this layout; cheap, and never raises."""
        ...

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The log at ``path``; images and sweeps stay on disk until they are asked for.

        ``sequence`` picks one where a folder holds several; the only one is the default.

        Raises:
            LogError: names the file (and line), what is wrong and what is expected. Tables are
                checked here; images and sweeps when they are read, or by ``check_log``.
        """
        ...
