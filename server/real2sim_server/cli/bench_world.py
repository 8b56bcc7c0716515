"""``real2sim bench world``."""

from __future__ import annotations

from pathlib import Path

from ..benchmarks import world
from ..console import write_json


def run(*, json_path: Path | None) -> None:
    """Measure steps of a world by itself and write the figures."""
    write_json(json_path, world.run())
