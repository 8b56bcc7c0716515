"""``real2sim log-info``: what a log holds, and whether its calibration is right."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import console, progress, write_json
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
        bool,
        typer.Option("--check", help="Check the header of every file and list bad files."),
    ] = False,
    everything: Annotated[
        bool, typer.Option("--all", help="Check the whole content of every file.")
    ] = False,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Summarise a log, draw its boxes and LiDAR, and check its files; exit code 1 for bad files."""
    from ..logs import check_log, inspect_log, inspected_frames
    from ..logs.open import open_log

    opened = open_log(log, format=log_format, sequence=sequence)
    report = inspect_log(opened, out)
    lines, checked, problems, shown = report.lines(), None, report.problems, report.problems
    if check or everything:
        with progress("checking files") as on_progress:
            checked = check_log(
                opened,
                sweeps=None if everything else inspected_frames(opened),
                decode_images=everything,
                on_progress=on_progress,
            )
        drawn = tuple(text for text in report.problems if text not in checked.problems)
        problems, shown = drawn + checked.problems, drawn + checked.summary()
        if checked.empty_sweeps:
            frames = ", ".join(map(str, checked.empty_sweeps))
            lines.append(f"question  no points in the sweeps of frames {frames}: are they lost?")
        more = "" if everything else "; --all reads all contents"
        lines.append(f"checked   {checked.done()}{more}")
        if not problems:
            lines.append("no problems found")
    lines += [f"problem   {text}" for text in shown]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    check_figures = checked and checked.as_json()
    write_json(json, {**report.as_json(), "problems": problems, "check": check_figures})
    if problems:
        raise typer.Exit(1)
