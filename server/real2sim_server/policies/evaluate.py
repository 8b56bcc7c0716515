"""``real2sim evaluate-policy``: planners x cases x seeds, scored from their recordings."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.markup import escape
from rich.table import Table

import real2sim

from .._files import atomic_file
from ..console import CommandError, console, staged_progress, write_json
from ..demo.street import unpack_street
from ..demo.worker import own_worker
from .episodes import Driven, Place, drive_all
from .page import page
from .suite import Asked, Case, cases_of, demo_cases, load_suite
from .summary import figures_of, groups_of, recompute

DEMO = "demo_street"
RECORDINGS, PAGE, FIGURES = "recordings", "report.html", "report.json"


@dataclass(frozen=True)
class Options:
    """What was asked for.

    Attributes:
        scenes, scenarios: to drive as recorded.
        suite: JSON file of cases instead; with none of the three the demo's street is driven.
        policies: planners by name.
        seeds: how many; from 0 on.
        url, token: of a running worker; without one, a worker is started.
        scenes_dir: bundles for the worker that is started.
        sessions: how many at a time.
    """

    policies: tuple[str, ...]
    scenes: tuple[str, ...] = ()
    scenarios: tuple[str, ...] = ()
    suite: Path | None = None
    seeds: int = 3
    url: str | None = None
    token: str | None = None
    scenes_dir: Path | None = None
    sessions: int = 2


def run(*, out: Path, options: Options) -> None:
    """Run all episodes; leave ``report.html``, ``report.json`` and recordings in ``out``.

    Raises:
        CommandError: options that contradict each other, a suite that is none, a planner that is
            unknown; scores that recordings do not bear out.
    """
    asked = Asked(_cases(options), options.policies, range(options.seeds))
    with _place(options, out) as place, staged_progress() as report:
        try:
            driven = drive_all(
                asked,
                place,
                out / RECORDINGS,
                on_progress=lambda done, count: report("drive", done, count),
            )
        except ValueError as error:
            raise CommandError(str(error)) from error
    figures = figures_of(driven, out)
    if differing := recompute(figures, out):
        raise CommandError(f"the scores of {differing[0]} are not those of its recording")
    write_json(out / FIGURES, figures)
    with atomic_file(out / PAGE) as file:
        file.write(page(driven, title="Planners compared").encode())
    _print(driven, out)


def _cases(options: Options) -> Sequence[Case]:
    named = options.scenes or options.scenarios
    if options.suite is not None:
        if named:
            raise CommandError("give scenes and scenarios, or a suite that names its own")
        return load_suite(options.suite)
    if named:
        return cases_of(options.scenes, options.scenarios)
    if options.url is not None or options.scenes_dir is not None:
        raise CommandError("name what to drive: --scene, --scenario or --suite")
    return demo_cases(DEMO)


@contextlib.contextmanager
def _place(options: Options, out: Path) -> Iterator[Place]:
    if options.url is not None:
        yield Place(options.url, options.token, options.sessions)
        return
    with contextlib.ExitStack() as stack:
        scenes = options.scenes_dir
        if scenes is None:
            scenes = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="real2sim-")))
            unpack_street(scenes, DEMO)
        worker = stack.enter_context(
            own_worker(scenes=scenes, data=out / "worker", log_file=out / "worker.log")
        )
        with real2sim.connect(worker.url) as client:
            client.wait_ready()
        yield Place(worker.url, None, options.sessions)


def _print(driven: Sequence[Driven], out: Path) -> None:
    groups = [group for group in groups_of(driven) if group.case is None]
    table = Table(title="mean over cases and seeds", title_justify="left")
    table.add_column("score")
    for group in groups:
        table.add_column(escape(group.policy), justify="right", overflow="fold")
    for name in groups[0].scores:
        spreads = [group.scores[name] for group in groups]
        table.add_row(name, *("–" if s is None else f"{s.mean:.3g}" for s in spreads))
    table.add_row("collisions at fault", *(str(group.at_fault) for group in groups))
    console.print(table)
    console.print(f"in {out}: {PAGE}, {FIGURES}, {RECORDINGS}/", highlight=False)
