"""``real2sim serve``: start a worker and stay in front."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..console import CommandError
from .command import command


@command("serve")
def serve(
    *,
    host: Annotated[
        str | None, typer.Option(help="Default 127.0.0.1; others need a token.")
    ] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="0 picks a free one.")] = None,
    scenes: Annotated[Path | None, typer.Option(help="Folder of scene bundles.")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder for scenarios and sessions.")] = None,
    token: Annotated[str | None, typer.Option(envvar="REAL2SIM_TOKEN", show_default=False)] = None,
    backend: Annotated[str | None, typer.Option(help="auto, cpu, cuda or reference")] = None,
) -> None:
    """Start a worker. Settings not given here come from REAL2SIM_* variables."""
    from pydantic import ValidationError

    from ..service.first_run import begin_compiling
    from ..service.preflight import check_start
    from ..settings import Settings

    options: dict[str, Any] = {
        "host": host,
        "port": port,
        "scenes_dir": scenes,
        "data_dir": data,
        "token": token,
        "backend": backend,
    }
    given = {name: value for name, value in options.items() if value is not None}
    try:
        settings = Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise CommandError(f"setting {name}: {first['msg']} (given: {first['input']!r})") from error
    # Before the worker's libraries are loaded, which takes seconds.
    check_start(settings)
    begin_compiling()
    from ..service import serve as worker

    if code := worker.run(settings):
        raise typer.Exit(code)
