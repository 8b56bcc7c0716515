"""``real2sim reconstruct``: from a driving log to a scene."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from ..reconstruct import reconstruct
from .console import console, print_figures, refuse_existing, staged_progress, write_json


def run(
    *,
    log: Path,
    out: Path,
    iterations: int,
    log_format: str | None,
    sequence: str | None,
    overwrite: bool,
    json_path: Path | None,
) -> None:
    """Reconstruct the log in folder ``log`` into the bundle ``out``."""
    refuse_existing(out, overwrite=overwrite)
    with staged_progress() as report:
        result = reconstruct(
            log,
            out,
            iterations=iterations,
            log_format=log_format,
            sequence=sequence,
            overwrite=overwrite,
            on_progress=report,
        )
    figures = asdict(result)
    print_figures(f"scene {out}", figures)
    console.print(f"next: real2sim render {out} --log {log} -o {out.name}.png")
    write_json(json_path, figures)
