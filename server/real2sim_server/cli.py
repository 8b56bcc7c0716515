"""The worker's part of the ``real2sim`` command. Heavy modules are imported by the command that runs."""

from __future__ import annotations

import typer

app = typer.Typer(no_args_is_help=True)
