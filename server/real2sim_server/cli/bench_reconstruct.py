"""``real2sim bench reconstruct``."""

from __future__ import annotations

from pathlib import Path

from ..benchmarks import reconstruct as bench
from ..console import print_figures, write_json


def run(*, json_path: Path | None) -> None:
    """Measure training and write the figures."""
    figures = bench.run()
    stages = {f"{name} [ms]": ms for name, ms in figures["stage_ms"].items()}
    others = {name: value for name, value in figures.items() if name != "stage_ms"}
    print_figures("training", others | stages)
    write_json(json_path, figures)
