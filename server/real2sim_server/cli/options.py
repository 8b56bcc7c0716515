"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

JsonFile = Annotated[
    Path | None, typer.Option("--json", help="Also write the figures to this file.", dir_okay=False)
]
SceneBundle = Annotated[Path, typer.Argument(help="Scene bundle.")]
LogFolder = Annotated[Path, typer.Argument(help="Folder of a driving log.")]
LogFormat = Annotated[str | None, typer.Option("--format", help="Default: recognised.")]
Sequence = Annotated[str | None, typer.Option(help="Where a dataset holds several.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
RenderBackend = Annotated[str, typer.Option(help="auto, cpu, cuda or reference")]
RenderDevice = Annotated[
    str | None, typer.Option(help="cpu, cuda, cuda:1 ...; default: that of the backend.")
]
