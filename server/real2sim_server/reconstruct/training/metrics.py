"""The figures of a run, one JSON object a line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class MetricsFile:
    """Appends to ``path``; lines are whole, so that others may read along.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)

    def write(self, figures: Mapping[str, Any]) -> None:
        """Append one line."""
        with self.path.open("a", encoding="ascii") as file:
            file.write(json.dumps(figures) + "\n")

    def read(self) -> list[dict[str, Any]]:
        """All whole lines; what a kill cut off is left out."""
        if not self.path.exists():
            return []
        lines = self.path.read_text(encoding="ascii").split("\n")[:-1]
        return [json.loads(line) for line in lines]

    def cut(self, iteration: int) -> None:
        """Drop what came after ``iteration``, as a resumed run writes it again."""
        kept = [line for line in self.read() if line["iteration"] <= iteration]
        temporary = self.path.with_name(f".{self.path.name}.tmp")
        temporary.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="ascii")
        temporary.replace(self.path)
