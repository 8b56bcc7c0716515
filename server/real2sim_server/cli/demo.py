"""``real2sim demo``: take a street, serve it, edit it over REST, drive it over WebSocket."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .command import command


@command("demo")
def demo(
    *,
    out: Annotated[Path, typer.Option("--out", help="Output folder.")] = Path("out/demo"),
    steps: Annotated[int, typer.Option(min=1, max=10_000)] = 100,
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
