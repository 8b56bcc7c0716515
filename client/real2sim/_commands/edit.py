"""``real2sim edit``: apply a file of operations to a scenario."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .options import DEFAULT_URL, JsonFile, Timeout, Token, Url, connected, write_json

if TYPE_CHECKING:
    from real2sim import Client
    from real2sim_proto.scenarios import OperationResult

app = typer.Typer()


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
    scene: Annotated[str | None, typer.Option(help="Make a new scenario on this scene.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Edit this scenario.")] = None,
    name: Annotated[str, typer.Option(help="Name of the new scenario.")] = "",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check, change nothing.")] = False,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 30.0,
    json_file: JsonFile = None,
) -> None:
    """Apply operations to a scenario; all of them, or none.

    A new scenario is only kept where they apply, and never after --dry-run.
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
    """Id of a new scenario, None where it was not kept, and what the edit gave."""
    from real2sim import Real2SimError

    handle = client.scenarios.create(scene=scene, name=name)
    kept = False
    try:
        result = handle.apply(batch, dry_run=dry_run)
        kept = not dry_run
    finally:
        if not kept:
            # What went wrong with the edit matters more than a scenario that stays behind.
            with contextlib.suppress(Real2SimError):
                client.scenarios.delete(handle)
    return handle.scenario_id if kept else None, result


def _read(path: Path) -> list[Any]:
    text = typer.get_text_stream("stdin").read() if str(path) == "-" else path.read_text("utf-8")
    try:
        batch = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(batch, list):
        raise ValueError(f"{path} holds a {type(batch).__name__}; give a list of operations")
    return batch
