"""``real2sim scenario`` and ``real2sim edit``: OpenSCENARIO files, the gallery, operations."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .options import DEFAULT_URL, JsonFile, Timeout, Token, Url, connected, console, write_json

if TYPE_CHECKING:
    from real2sim_proto.scenarios import OperationResult

    from .. import Client


app = typer.Typer()
scenario = typer.Typer(
    no_args_is_help=True, help="Add corner cases and OpenSCENARIO files to scenarios."
)
app.add_typer(scenario, name="scenario")

Scenario = Annotated[str, typer.Argument(help="Id of the scenario.")]


@scenario.command("gallery")
def gallery(
    *,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 30.0,
    json_file: JsonFile = None,
) -> None:
    """List the corner cases of the gallery with their parameters."""
    with connected(url, token, timeout) as client:
        cases = client.scenarios.gallery()
    if json_file is not None:
        write_json(json_file, {"cases": [case.model_dump(mode="json") for case in cases]})
        return
    from rich.table import Table

    table = Table("name", "what happens", "parameters")
    for case in cases:
        values = ", ".join(f"{name}={value:g}" for name, value in case.parameters.items())
        table.add_row(case.name, case.title, values)
    console().print(table)


@scenario.command("apply")
def apply(
    *,
    case: Annotated[str, typer.Argument(help="Name of the corner case.")],
    scenario_id: Annotated[
        str | None, typer.Option("--scenario", help="Scenario to change; or use --scene.")
    ] = None,
    scene: Annotated[str | None, typer.Option(help="Create a new scenario on this scene.")] = None,
    values: Annotated[
        list[str] | None, typer.Option("--set", help="Parameter as NAME=VALUE; repeatable.")
    ] = None,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 30.0,
) -> None:
    """Add a corner case to a scenario."""
    if (scene is None) == (scenario_id is None):
        raise typer.BadParameter("give exactly one of --scene and --scenario")
    from .. import Real2SimError

    given = dict(_parameter(text) for text in values or ())
    with connected(url, token, timeout) as client:
        if scene is None:
            handle = client.scenarios.get(str(scenario_id))
        else:
            handle = client.scenarios.create(scene=scene, name=case)
        try:
            handle.apply_corner_case(case, **given)
        except Real2SimError:
            if scene is not None:
                with contextlib.suppress(Real2SimError):
                    client.scenarios.delete(handle)
            raise
    typer.echo(f"{case} happens in scenario {handle.scenario_id}, revision {handle.revision}")


@scenario.command("import")
def import_(
    *,
    scenario_id: Scenario,
    file: Annotated[Path, typer.Argument(help="OpenSCENARIO 1.0 to 1.3 (.xosc).")],
    leave_out: Annotated[
        list[str] | None,
        typer.Option("--leave-out", help="Element of the file to ignore; repeatable."),
    ] = None,
    ego: Annotated[str | None, typer.Option(help="Name of the ego entity; default: Ego.")] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse elements that have no effect on the drive.")
    ] = False,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 30.0,
) -> None:
    """Use an OpenSCENARIO file in a scenario."""
    with connected(url, token, timeout) as client:
        handle = client.scenarios.get(scenario_id)
        result = handle.read_xosc(file, leave_out=leave_out or (), ego=ego, strict=strict)
    typer.echo(f"{file.name} happens in scenario {scenario_id}, revision {result.revision}")
    for note in result.notes:
        typer.echo(f"note: {note}", err=True)


@scenario.command("export")
def export(
    *,
    scenario_id: Scenario,
    file: Annotated[Path, typer.Argument(help="OpenSCENARIO 1.3 (.xosc) to write.")],
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 30.0,
) -> None:
    """Export the storyboard of a scenario as an OpenSCENARIO file."""
    with connected(url, token, timeout) as client:
        client.scenarios.get(scenario_id).write_xosc(file)
    typer.echo(f"wrote {file}")


def _parameter(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    try:
        if name and equals:
            return name, float(value)
    except ValueError:
        pass
    raise typer.BadParameter(f"--set {text!r}; allowed is name=number, such as gap=12")


# Operations from a file.


@app.command()
def edit(
    *,
    operations: Annotated[
        Path,
        typer.Argument(
            help="JSON list of operations, e.g. "
            '[{"op": "translate", "object_id": "car_3", "y": 3.2}]; "-" reads standard input.',
            allow_dash=True,
        ),
    ],
    scene: Annotated[str | None, typer.Option(help="Create a new scenario on this scene.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Edit this scenario.")] = None,
    name: Annotated[str, typer.Option(help="Name of the new scenario.")] = "",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Validate only.")] = False,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 30.0,
    json_file: JsonFile = None,
) -> None:
    """Apply a file of operations to a scenario, all or none.

    With --scene, the new scenario is deleted if the edit fails or with --dry-run.
    """
    if (scene is None) == (scenario is None):
        raise typer.BadParameter("give exactly one of --scene and --scenario")
    batch = _read(operations)
    with connected(url, token, timeout) as client:
        if scene is not None:
            scenario_id, result = _edit_new(client, scene, name, batch, dry_run=dry_run)
        else:
            scenario_id = scenario
            result = client.scenarios.get(str(scenario)).apply(batch, dry_run=dry_run)
    if json_file is not None:
        write_json(json_file, result.model_dump(mode="json") | {"scenario_id": scenario_id})
        return
    done = "would apply" if dry_run else "applied"
    where = f"scenario {scenario_id}" if scenario_id else f"a new scenario on {scene}"
    typer.echo(f"{done} {len(batch)} operations to {where}")
    typer.echo(f"revision {result.revision}; new objects: {', '.join(result.created) or 'none'}")
    for warning in result.warnings:
        typer.echo(f"warning: {warning.message}", err=True)


def _edit_new(
    client: Client, scene: str, name: str, batch: list[Any], *, dry_run: bool
) -> tuple[str | None, OperationResult]:
    """Edit a new scenario; return its id, or None if it was deleted, and the result of the edit."""
    from .. import Real2SimError

    handle = client.scenarios.create(scene=scene, name=name)
    kept = False
    try:
        result = handle.apply(batch, dry_run=dry_run)
        kept = not dry_run
    finally:
        if not kept:
            # An error here would hide the error of the edit.
            with contextlib.suppress(Real2SimError):
                client.scenarios.delete(handle)
    return handle.scenario_id if kept else None, result


def _read(path: Path) -> list[Any]:
    text = (
        typer.get_text_stream("stdin").read() if str(path) == "-" else path.read_text("utf-8-sig")
    )
    try:
        batch = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(batch, list):
        raise ValueError(f"{path} holds a {type(batch).__name__}; give a list of operations")
    return batch
