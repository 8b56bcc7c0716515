"""``real2sim validate``: the solver against theory; exit code 1 when a line fails."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .._files import atomic_file
from ..console import console, progress, write_json
from .command import command
from .options import JsonFile

if TYPE_CHECKING:
    from ..physics.validation.table import CaseResult


@command("validate")
def validate(
    *,
    backend: Annotated[str, typer.Option(help="Solver: cpu or reference.")] = "cpu",
    cases: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated names, or a group: 'simulation' or 'published'; default: all "
            "except the published crash figures."
        ),
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="HTML report to write; default: next to the JSON file.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Compare the physics with known solutions; exit code 1 if any fails."""
    from ..physics.validation.table import as_figures, render_page

    with progress("validating") as report:
        results = _run(backend, cases, report)
    figures = as_figures(results, backend)
    write_json(json, figures)
    if page is None and json is not None:
        page = json.with_suffix(".html")
    if page is not None:
        with atomic_file(page) as file:
            file.write(render_page(results, backend=backend).encode())
    _print_results(results)
    if page is not None:
        console.print(f"page: {page}", highlight=False, soft_wrap=True)
    if not figures["passed"]:
        raise typer.Exit(1)


def _run(backend: str, cases: str | None, report: Callable[[int, int], None]) -> list[CaseResult]:
    """The cases asked for; ``published`` stands for all of the published crash figures, and
    ``simulation`` for all of bodies that roll, hand over and hit thin things."""
    from ..physics.validation import table
    from ..simulation.experiments.crash_tests import PUBLISHED, THEORY

    names = [*table.CASES, *THEORY]
    if cases is not None:
        names = [name.strip() for name in cases.split(",")]
    for group, members in (("published", PUBLISHED), ("simulation", THEORY)):
        if group in names:
            at = names.index(group)
            names[at : at + 1] = members
    available = {**table.CASES, **THEORY, **PUBLISHED}
    return table.run_table(backend=backend, cases=names, available=available, on_progress=report)


def _print_results(results: Sequence[CaseResult]) -> None:
    lines = 0
    for result in results:
        for check in result.checks:
            lines += 1
            mark = "[green]holds[/]" if check.passed else "[bold red]FAILS[/]"
            console.print(
                f"{mark}  {check.name}: {check.measured:.5g}, expected {check.expected:.5g} "
                f"± {check.tolerance:.2g} {check.unit}".rstrip(),
                highlight=False,
                soft_wrap=True,
            )
        if result.error:
            console.print(f"[bold red]FAILS[/]  {result.name}: {result.error}", highlight=False)
    failed = sum(not r.passed for r in results)
    console.print(f"{lines} lines of {len(results)} cases; {failed} cases fail", highlight=False)
