"""The worker's part of the ``real2sim`` command.

This module is imported by every ``real2sim --help``, so it loads nothing heavy: each command
checks that its extra is installed and only then imports its room.
"""

from . import logs, scenes, physics, episodes, worker, bench  # noqa: I001 - the order of the help
from .options import app

__all__ = ["app", "bench", "episodes", "logs", "physics", "scenes", "worker"]
