"""``real2sim bench render``."""

from __future__ import annotations

from pathlib import Path

from ..benchmarks import render as bench
from ..console import write_json


def run(*, splat: Path | None, json_path: Path | None) -> None:
    """Measure the rasterizer and write the figures."""
    write_json(json_path, bench.run(splat=splat))
