"""``real2sim bench physics``."""

from __future__ import annotations

from pathlib import Path

from ..benchmarks import physics as bench
from ..console import print_figures, progress, write_json


def run(*, peers: bool, json_path: Path | None) -> None:
    """Measure the solver, and peers when asked to; print and write the figures."""
    with progress("measuring") as report:
        figures = bench.run(peers=peers, on_progress=report)
    print_figures("particle-substeps per second", bench.as_rows(figures))
    write_json(json_path, figures)
