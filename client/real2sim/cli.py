"""The ``real2sim`` command: the client's commands and those of installed packages.

Packages add commands through the entry-point group ``real2sim.commands``; each entry is a Typer
app, and its commands are listed together with the client's own.
"""

from __future__ import annotations

import os
import sys
from importlib.metadata import entry_points
from typing import Any

import typer
from typer.core import TyperGroup

from ._commands import adapter, drive, scenario, scenes

COMMAND_GROUP = "real2sim.commands"
DEBUG_VARIABLE = "REAL2SIM_DEBUG"

PANELS = {
    "Try": "demo synth doctor",
    "Logs and scenes": "log-info track reconstruct evaluate render scenes frame import export map "
    "ground fit-lidar fit-uncertainty",
    "Edit and physics": "edit scenario simulate film calibrate validate",
    "Drive": "drive run gallery replay evaluate-policy sweep search adapter ros2",
    "Data": "export-dataset train-policy",
    "Operate": "serve status token store backup restore bench",
}
"""Commands by panel, in the order of the help; commands of other packages follow."""


def main() -> None:
    """Run the command; errors become one sentence, a hint and exit code 1."""
    try:
        build_app()()
    except Exception as error:
        if os.environ.get(DEBUG_VARIABLE) == "1":
            raise
        print_error(error)
        sys.exit(1)


def build_app() -> typer.Typer:
    """The command with the subcommands of all installed packages."""
    app = typer.Typer(
        name="real2sim",
        cls=_Panels,
        help="Drive a policy through a reconstructed street over the network.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        # Rich's own markup would read units in square brackets as styles and drop them.
        rich_markup_mode="markdown",
    )
    app.callback(invoke_without_command=True)(_options)
    for module in (scenes, scenario, drive, adapter):
        app.add_typer(module.app)
    own = ", ".join(f"`{name}`" for name in typer.main.get_group(app).commands)
    app.info.epilog = (
        f"With the SDK alone you have {own}. The others come with `pip install 'real2sim[server]'`."
    )
    for entry in sorted(entry_points(group=COMMAND_GROUP), key=lambda e: e.name):
        try:
            app.add_typer(entry.load())
        except Exception as error:
            # A broken extension must not disable the client's own commands.
            typer.echo(f"warning: the commands of {entry.value!r} are missing: {error}", err=True)
    return app


class _Panels(TyperGroup):
    """Lists its commands panel by panel."""

    def list_commands(self, ctx: Any) -> list[str]:
        known = " ".join(PANELS.values()).split()
        there = super().list_commands(ctx)
        return sorted(there, key=lambda name: known.index(name) if name in known else len(known))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        found: Any = super().get_command(ctx, cmd_name)
        for panel, names in PANELS.items():
            if found is not None and cmd_name in names.split():
                found.rich_help_panel = panel
        return found


def print_error(error: Exception) -> None:
    """Print the error in one sentence, and a hint, to standard error."""
    said = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    known = isinstance(error, ValueError | OSError | KeyError) or hasattr(error, "hint")
    sentence = said if said and known else f"{type(error).__name__}: {said or 'no reason given'}"
    hint = getattr(error, "hint", None)
    if hint is None and not known:
        hint = f"{DEBUG_VARIABLE}=1 shows where it happened"
    typer.echo(f"{typer.style('error:', fg='red', bold=True)} {sentence}", err=True)
    if hint:
        typer.echo(f"{typer.style('hint:', fg='cyan', bold=True)} {hint}", err=True)


def _version(wanted: bool) -> None:
    if wanted:
        from .version import VERSION

        typer.echo(f"real2sim {VERSION}")
        raise typer.Exit


def _options(
    _version_wanted: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    return None


if __name__ == "__main__":
    main()
