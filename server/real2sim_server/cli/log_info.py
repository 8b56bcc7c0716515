"""``real2sim log-info``: what a log holds, and whether its calibration is right."""

from __future__ import annotations

from pathlib import Path

from ..console import console, write_json
from ..logs import check_log, inspect_log
from ..logs.open import open_log


def run(
    *,
    log: Path,
    out: Path | None,
    log_format: str | None,
    sequence: str | None,
    check: bool,
    json_path: Path | None,
) -> None:
    """Print what the log in ``log`` holds; draw boxes and LiDAR on its images into ``out``."""
    opened = open_log(log, format=log_format, sequence=sequence)
    report = inspect_log(opened, out)
    for line in report.lines():
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if check:
        check_log(opened)
        console.print("every file of the log was looked at: none is missing or cut off")
    write_json(json_path, report.as_json())
