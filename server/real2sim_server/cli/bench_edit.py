"""``real2sim bench edit``."""

from __future__ import annotations

from pathlib import Path

from ..benchmarks import edit
from ..console import write_json


def run(*, operations: int, json_path: Path | None) -> None:
    """Measure edits over loopback and write the figures."""
    write_json(json_path, edit.run(edit.Effort(operations=operations)))
