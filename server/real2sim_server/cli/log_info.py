"""``real2sim log-info``: what a log holds, and whether its calibration is right."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import console, write_json
from .command import command
from .options import JsonFile, LogFolder, LogFormat, Sequence


@command("log-info")
def log_info(
    *,
    log: LogFolder,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for pictures with boxes and LiDAR.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Look at every file, as training does first.")
    ] = False,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Say what a log holds, and draw its boxes and LiDAR on its images."""
    from ..logs import check_log, inspect_log
    from ..logs.open import open_log

    opened = open_log(log, format=log_format, sequence=sequence)
    report = inspect_log(opened, out)
    for line in report.lines():
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if check:
        empty = check_log(opened)
        console.print("every image's header and every sweep was read: none is missing or cut off")
        if empty:
            console.print(f"but the sweeps of {len(empty)} frames hold no points: {empty}")
    write_json(json, report.as_json())
