"""``real2sim bench serve``."""

from __future__ import annotations

from pathlib import Path

from ..benchmarks import serve
from ..console import write_json


def run(*, json_path: Path | None) -> None:
    """Measure a worker over loopback and write the figures."""
    write_json(json_path, serve.run())
