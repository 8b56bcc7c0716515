"""``real2sim bench physics``."""

from __future__ import annotations

from pathlib import Path

from ..physics import bench
from .console import write_json


def run(*, peers: bool, json_path: Path | None) -> None:
    """Measure the solver and write the figures."""
    write_json(json_path, bench.run(peers=peers))
