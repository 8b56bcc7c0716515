"""Commands around the worker itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import JsonFile, app, run_command


@app.command()
def serve(
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
    from . import serve as command

    run_command(
        command.run,
        overrides={
            "host": host,
            "port": port,
            "scenes_dir": scenes,
            "data_dir": data,
            "token": token,
            "backend": backend,
        },
    )


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Where results go.")] = Path("out/demo"),
    steps: Annotated[int, typer.Option(min=1, max=10_000)] = 100,
    from_log: Annotated[
        bool, typer.Option("--from-log", help="Record and reconstruct the street first.")
    ] = False,
    serve: Annotated[bool, typer.Option("--serve", help="Leave the worker up afterwards.")] = False,
) -> None:
    """Serve a street, edit it over REST, drive it over WebSocket, leave video and figures."""
    from ..demo import run as command

    run_command(command.run, out=out, steps=steps, from_log=from_log, leave_serving=serve)


@app.command()
def doctor(
    warm: Annotated[
        bool, typer.Option("--warm", help="Compile all kernels into the cache.")
    ] = False,
    json: JsonFile = None,
) -> None:
    """Say what this machine can do, what is missing, and how to mend it."""
    from . import doctor as command

    command.run(warm=warm, json_path=json)
