"""Options shared by several commands, and their conversion."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from real2sim import Client
    from real2sim.images import Image

Url = Annotated[str, typer.Option("--url", envvar="REAL2SIM_URL", help="Address of the worker.")]
Token = Annotated[
    str | None,
    typer.Option(
        "--token", envvar="REAL2SIM_TOKEN", show_envvar=True, help="Bearer token of the worker."
    ),
]
Timeout = Annotated[float, typer.Option("--timeout", min=0.1, help="Seconds to wait for a reply.")]
JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write the results as JSON; '-' prints them."),
]

DEFAULT_URL = "http://127.0.0.1:8600"
"""Same as the default of ``real2sim.connect``; importing that module would slow every command."""


def connected(url: str, token: str | None, timeout: float = 30.0) -> Client:
    """A client of the worker given by the options."""
    import real2sim

    return real2sim.connect(url, token=token, timeout=timeout)


def json_object(flag: str, text: str | None) -> dict[str, Any]:
    """Parse the JSON object in a flag's value; empty if the flag is missing.

    Raises:
        typer.BadParameter: the value is not a JSON object.
    """
    try:
        found = json.loads(text or "{}")
    except json.JSONDecodeError as error:
        raise typer.BadParameter(f"{flag} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise typer.BadParameter(f"{flag} is not a JSON object, as {{}} is")
    return found


def console() -> Console:
    """Console for tables. Do not use it with ``--json -``, which writes to standard output."""
    from rich.console import Console

    return Console()


def write_json(path: Path, figures: Any) -> None:
    """Write figures as JSON, atomically; '-' is standard output."""
    text = json.dumps(figures, indent=2, allow_nan=False) + "\n"
    if str(path) == "-":
        typer.echo(text, nl=False)
        return
    from real2sim.images import write_atomically

    write_atomically(path, text.encode())


def save_image(image: Image, path: Path) -> None:
    """Write an image and print its path and size."""
    saved = image.save(path)
    typer.echo(f"wrote {saved} ({saved.stat().st_size / 1024:.0f} KiB)")
