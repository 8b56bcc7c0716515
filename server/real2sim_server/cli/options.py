"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError

if TYPE_CHECKING:
    from ..logs import LogSelection

JsonFile = Annotated[
    Path | None, typer.Option("--json", help="Also write the figures to this file.", dir_okay=False)
]
SceneBundle = Annotated[Path, typer.Argument(help="Scene bundle.")]
LogFolder = Annotated[Path, typer.Argument(help="Folder of a driving log.")]
LogFormat = Annotated[str | None, typer.Option("--format", help="Default: recognised.")]
Sequence = Annotated[str | None, typer.Option(help="Where a dataset holds several.")]
LogFrames = Annotated[
    str, typer.Option(help="Stretch of the log, first:stop such as 50:100, stop not included.")
]
LogCameras = Annotated[
    str | None, typer.Option(help="Of the log, such as front,front_left; default: all.")
]
LogEvery = Annotated[int, typer.Option(min=1, help="Of the log's frames, each so many-th.")]
Follow = Annotated[
    bool,
    typer.Option(
        "--follow",
        help="For programs: progress as lines of JSON on standard output, and an end with the end "
        "of standard input.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
RenderBackend = Annotated[str, typer.Option(help="auto, cpu, cuda or reference")]
RenderDevice = Annotated[
    str | None, typer.Option(help="cpu, cuda, cuda:1 ...; default: that of the backend.")
]


def log_selection(frames: str, cameras: str | None, every: int) -> LogSelection:
    """Of ``--frames``, ``--cameras`` and ``--every``. Raises CommandError."""
    from ..logs import LogSelection

    first, colon, stop = frames.partition(":")
    numbers = [part.strip() for part in (first, stop)]
    if not colon or not all(part.isdecimal() or not part for part in numbers):
        raise CommandError(
            f"--frames {frames!r}; allowed is a stretch first:stop such as 50:100, 50: or :100"
        )
    names = None if cameras is None else tuple(name.strip() for name in cameras.split(","))
    return LogSelection(int(numbers[0] or 0), int(numbers[1]) if numbers[1] else None, every, names)
