"""``real2sim sweep``: many variants of a case, as one table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import CommandError, print_figures, told_progress
from .command import command
from .options import Follow, JsonFile


@command("sweep")
def sweep(
    *,
    spec: Annotated[Path, typer.Argument(help="sweep.yaml or .json, see docs/sweeps.md.")],
    out: Annotated[Path, typer.Option("--out", help="Folder; what is there is gone on with.")],
    scenes: Annotated[
        Path | None, typer.Option("--scenes", help="Folder of bundles, for scenes by name.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, max=4096, help="Episodes at a time.")] = 1,
    executor: Annotated[str, typer.Option(help="processes, or ray.")] = "processes",
    ray_address: Annotated[
        str | None, typer.Option(help="Of a Ray cluster; default: one on this machine.")
    ] = None,
    json: JsonFile = None,
    follow: Follow = False,
) -> None:
    """Drive points of a parameter space with planners, without images unless they need some.

    Leaves episodes.parquet, a row an episode, and recordings and scenario files of the worst.
    Killed, the same command goes on; the table is the same bytes whoever drove, and however often
    it was killed.
    """
    from ..console import write_json
    from ..executors import ExecutorError, executor_of
    from ..sweeps import load_sweep, run_sweep

    asked = load_sweep(spec, scenes)
    try:
        who = executor_of(executor, workers=workers, address=ray_address)
        with told_progress(follow=follow) as report:
            figures = run_sweep(asked, out, who, scenes=scenes, on_progress=report)
    except ExecutorError as error:
        raise CommandError(str(error)) from error
    write_json(json, figures)
    if not follow:
        print_figures(f"sweep of {asked.case.name}", figures)
