"""Commands that start a worker: serve and demo."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from ..console import LISTENERS, CommandError, errors
from .common import command, read_settings

# --- serve ----------------------------------------------------------------------------------------


@command("serve")
def serve(
    *,
    host: Annotated[
        str | None,
        typer.Option(help="Address to listen on, 127.0.0.1 by default; any other needs a token."),
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port; 0 picks a free one.")
    ] = None,
    scenes: Annotated[Path | None, typer.Option(help="Folder of scene bundles.")] = None,
    demo: Annotated[
        bool, typer.Option("--demo", help="Add the demo street to the scenes.")
    ] = False,
    data: Annotated[Path | None, typer.Option(help="Folder for scenarios and sessions.")] = None,
    token_file: Annotated[
        Path | None, typer.Option(help="File with the token; or set REAL2SIM_TOKEN.")
    ] = None,
    token: Annotated[
        str | None, typer.Option(help="Visible in the process list: prefer --token-file.")
    ] = None,
    backend: Annotated[
        str | None, typer.Option(help="Renderer: auto, cpu, cuda, nvrtc or reference.")
    ] = None,
) -> None:
    """Start a worker. Other settings come from REAL2SIM_* variables."""
    from ..service.preflight import begin_compiling, check_start
    from ..settings import read_token

    _check_variables()
    if token is not None:
        _warn("--token shows in the process list; give --token-file, or set REAL2SIM_TOKEN")
    elif token_file is not None:
        try:
            token = read_token(token_file)
        except ValueError as error:
            raise CommandError(str(error)) from error
    options: dict[str, Any] = {
        "host": host,
        "port": port,
        "scenes_dir": scenes,
        "demo": demo or None,
        "data_dir": data,
        "token": token,
        "backend": backend,
    }
    given = {name: value for name, value in options.items() if value is not None}
    settings = read_settings(**given)
    # Fail before the worker's libraries load, which takes seconds.
    check_start(settings)
    begin_compiling()
    # The worker itself reports kernel compilation, including that of other processes.
    LISTENERS.append(lambda _text: None)
    from ..service import serve as worker

    if code := worker.run(settings):
        raise typer.Exit(code)


def _check_variables() -> None:
    """Reject misspelt settings and warn about other unknown ones.

    Raises:
        CommandError: names the variable and the most similar setting.
    """
    from ..settings import unknown_variables

    for name, nearest in unknown_variables(os.environ).items():
        if nearest is not None:
            raise CommandError(
                f"{name} is not a setting; do you mean {nearest}? Correct it, or unset {name}"
            )
        _warn(f"{name} is not a setting and is ignored")


def _warn(message: str) -> None:
    errors.print(f"[yellow]warning:[/] {escape(message)}", highlight=False, soft_wrap=True)


# --- demo -----------------------------------------------------------------------------------------


@command("demo")
def demo(
    *,
    out: Annotated[Path, typer.Option("--out", help="Output folder.")] = Path("out/demo"),
    steps: Annotated[int, typer.Option(min=1, max=10_000, help="Steps to drive.")] = 100,
    from_log: Annotated[
        bool, typer.Option("--from-log", help="Record and reconstruct the street first.")
    ] = False,
    serve: Annotated[
        bool, typer.Option("--serve", help="Keep the worker running afterwards.")
    ] = False,
) -> None:
    """Serve a street, edit it over REST, drive it over WebSocket, and write video and figures."""
    from ..demo.run import run

    run(out=out, steps=steps, from_log=from_log, leave_serving=serve)
