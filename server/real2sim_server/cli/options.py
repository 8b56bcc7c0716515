"""What the modules of commands share: the command itself, and options that several have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(no_args_is_help=True)
bench = typer.Typer(no_args_is_help=True, help="Measure this machine; ratios to a reference.")
app.add_typer(bench, name="bench")

JsonFile = Annotated[
    Path | None, typer.Option("--json", help="Also write the figures to this file.", dir_okay=False)
]
LogFormat = Annotated[str | None, typer.Option("--format", help="Default: recognised.")]
Sequence = Annotated[str | None, typer.Option(help="Where a dataset holds several.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]


def run_command(command: Any, **arguments: Any) -> None:
    """Run a command's function; what it raises for the user is printed as a sentence."""
    from .. import console

    console.run_command(command, **arguments)
