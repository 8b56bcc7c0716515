"""``real2sim search``: the avoidable failures of a planner."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import console, print_figures, told_progress
from .command import command
from .options import Follow, JsonFile


@command("search")
def search(
    *,
    spaces: Annotated[
        list[str],
        typer.Argument(help="Files as of `sweep`, or shipped: cut_in, hard_brake, oncoming, ..."),
    ],
    planner: Annotated[str, typer.Option(help="As for `drive`, see docs/policies.md.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for failures and page.")],
    episodes: Annotated[int, typer.Option(min=20, max=100_000)] = 300,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    shrink: Annotated[int, typer.Option(min=0, help="Failures whose boundary is sought.")] = 3,
    probability: Annotated[
        int, typer.Option(min=0, help="Episodes for how often the planner fails; 0: none.")
    ] = 0,
    films: Annotated[int, typer.Option(min=0, help="Failures to film.")] = 0,
    scenes: Annotated[
        Path | None, typer.Option("--scenes", help="Folder of bundles, for scenes by name.")
    ] = None,
    json: JsonFile = None,
    follow: Follow = False,
) -> None:
    """Find collisions that are a planner's fault and that a driver who knows what comes avoids.

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
