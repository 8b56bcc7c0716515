"""``real2sim sweep`` and ``real2sim search``: variants of a case, and avoidable failures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import CommandError, console, print_figures, told_progress
from .command import command
from .options import Follow, JsonFile


@command("sweep")
def sweep(
    *,
    spec: Annotated[Path, typer.Argument(help="sweep.yaml or .json, see docs/sweeps.md.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder; an existing sweep resumes.")],
    scenes: Annotated[
        Path | None, typer.Option("--scenes", help="Folder of scene bundles.")
    ] = None,
    workers: Annotated[
        int, typer.Option(min=1, max=4096, help="Episodes to drive in parallel.")
    ] = 1,
    executor: Annotated[str, typer.Option(help="Run in local processes or on ray.")] = "processes",
    ray_address: Annotated[
        str | None, typer.Option(help="Address of a Ray cluster; default: start one.")
    ] = None,
    json: JsonFile = None,
    follow: Follow = False,
) -> None:
    """Drive points of a parameter space with planners; renders only what planners need.

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


# ``real2sim search``: the avoidable failures of a planner.


@command("search")
def search(
    *,
    spaces: Annotated[
        list[str],
        typer.Argument(help="Files as for `sweep`, or shipped: cut_in, hard_brake, oncoming, ..."),
    ],
    planner: Annotated[str, typer.Option(help="Planner as for `drive`, see docs/policies.md.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder for failures and the report.")],
    episodes: Annotated[int, typer.Option(min=20, max=100_000)] = 300,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    shrink: Annotated[
        int, typer.Option(min=0, help="Number of failures to shrink to their boundary.")
    ] = 3,
    probability: Annotated[
        int, typer.Option(min=0, help="Episodes to estimate the failure rate; 0: none.")
    ] = 0,
    films: Annotated[int, typer.Option(min=0, help="Number of failures to film.")] = 0,
    scenes: Annotated[
        Path | None, typer.Option("--scenes", help="Folder of scene bundles.")
    ] = None,
    json: JsonFile = None,
    follow: Follow = False,
) -> None:
    """Find avoidable collisions that are the planner's fault.

    Leaves failures.json, each failure as a case and as a recording, and a page; see docs/sweeps.md.
    """
    from ..console import write_json
    from ..sweeps import load_space
    from ..sweeps.search.optimise import SearchBudget
    from ..sweeps.search.run import SearchOptions, run_search

    options = SearchOptions(
        budget=SearchBudget(episodes=episodes, seed=seed),
        shrink=shrink,
        probability=probability,
        films=films,
        scenes=scenes,
    )
    asked = [load_space(name, scenes) for name in spaces]
    with told_progress(follow=follow) as report:
        found = run_search(asked, planner, out, options, on_progress=report)
    write_json(json, found)
    if follow:
        return
    keys = ("episodes", "first_failure", "at_fault", "avoidable", "cells")
    print_figures(f"failures of {planner}", {k: found[k] for k in keys})
    console.print(f"wrote {out / 'failures.html'} and {out / 'failures.json'}")
