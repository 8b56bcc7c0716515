"""Policy commands: evaluate-policy and train-policy."""

from __future__ import annotations

import contextlib
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from .._files import atomic_file
from ..console import CommandError, console, errors, print_figures, staged_progress, write_json
from .common import JsonFile, LogFormat, PlanLimit, SequenceName, command, opened_log

if TYPE_CHECKING:
    from real2sim.planners.learned import PolicyShape

    from ..policies.cloning import CloningDataset, PosedImage
    from ..policies.episodes import EpisodeResult
    from ..policies.suite import Case, EpisodeGrid
    from ..scene import CameraRig


# --- evaluate-policy ------------------------------------------------------------------------------

RECORDINGS, PAGE, FIGURES = "recordings", "report.html", "report.json"
DEFAULT_SEEDS = 3


@command("evaluate-policy")
def evaluate_policy(
    *,
    out: Annotated[Path, typer.Option("--out", help="Folder for the report and recordings.")],
    policies: Annotated[
        list[str],
        typer.Option(
            "--policy", help="follow_route, pid, idm, depth_sampling, learned=FILE, module:Class."
        ),
    ],
    scenes: Annotated[
        list[str] | None, typer.Option("--scene", help="Scene to drive as recorded; repeatable.")
    ] = None,
    scenarios: Annotated[
        list[str] | None, typer.Option("--scenario", help="Id of a scenario to drive; repeatable.")
    ] = None,
    suite: Annotated[
        Path | None,
        typer.Option(
            help="JSON file of cases, or name of a shipped suite; default: demo, three cases on "
            "the demo street."
        ),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1000,
            help="Number of seeds for cases with random parts (jitter, randomization, "
            "agents.spawn); default: 3. Other cases are driven once.",
        ),
    ] = None,
    reset: Annotated[
        str | None,
        typer.Option(
            help="Options of reset for --scene and --scenario, as JSON, for example "
            '\'{"randomization": {"start": {"lateral": 0.5}}}\'.'
        ),
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="Address of a running worker; default: start one.")
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(
            envvar="REAL2SIM_TOKEN", show_default=False, help="Bearer token of the worker."
        ),
    ] = None,
    scenes_dir: Annotated[
        Path | None,
        typer.Option("--scenes", help="Folder of bundles for the worker that is started."),
    ] = None,
    sessions: Annotated[
        int, typer.Option(min=1, max=64, help="Episodes to drive in parallel.")
    ] = 2,
    plan_limit: PlanLimit = 60.0,
) -> None:
    """Compare planners over cases: scores, recordings and an HTML report.

    Each planner runs in its own process. If a planner raises an exception, returns an invalid plan,
    exits or exceeds --plan-limit, this episode fails. The other episodes continue, and the exit
    code is 1.

    A suite lists cases: a scene or a scenario, options of `reset`, edits, and the `jitter` of
    numbers in them, which varies with the seed. See docs/policies.md for the format.
    """
    from ..policies.episodes import WorkerTarget, run_episodes
    from ..policies.page import render_page, report_figures, unconfirmed_scores
    from ..policies.suite import EpisodeGrid

    own_worker = url is None and scenes_dir is None
    cases = _cases(scenes or (), scenarios or (), suite, demo=own_worker, reset=reset)
    grid = EpisodeGrid(cases, policies, range(seeds or DEFAULT_SEEDS))
    with contextlib.ExitStack() as stack:
        if url is None:
            url, token = stack.enter_context(_own_worker(scenes_dir, out)), None
        report = stack.enter_context(staged_progress())
        try:
            results = run_episodes(
                grid,
                WorkerTarget(url, token, sessions),
                out / RECORDINGS,
                plan_limit_s=plan_limit,
                on_progress=lambda done, count: report("drive", done, count),
            )
        except ValueError as error:
            raise CommandError(str(error)) from error
    figures = report_figures(results, out)
    if differing := unconfirmed_scores(figures, out):
        raise CommandError(f"the scores of {differing[0]} are not those of its recording")
    write_json(out / FIGURES, figures)
    with atomic_file(out / PAGE) as file:
        file.write(render_page(results, title="Planners compared").encode())
    _print_scores(results)
    if seeds is not None:
        _print_what_ran_once(grid)
    console.print(f"in {out}: {PAGE}, {FIGURES}, {RECORDINGS}/", highlight=False)
    _tell_failures(results)


def _tell_failures(results: Sequence[EpisodeResult]) -> None:
    """Print why planners failed; exit with code 1 if any did."""
    failed = [one for one in results if one.error is not None]
    for policy in dict.fromkeys(one.policy for one in failed):
        own = [one for one in failed if one.policy == policy]
        driven = sum(one.policy == policy for one in results)
        errors.print(
            f"planner {policy} failed in {len(own)} of {driven} episodes, first in "
            f"{own[0].case}, seed {own[0].seed}: {own[0].error}",
            highlight=False, markup=False, soft_wrap=True, style="red",
        )  # fmt: skip
    if failed:
        raise typer.Exit(1)


def _cases(
    scenes: Sequence[str],
    scenarios: Sequence[str],
    suite: Path | None,
    *,
    demo: bool,
    reset: str | None = None,
) -> Sequence[Case]:
    from ..policies.suite import DEMO_SUITE, cases_as_recorded, load_suite

    if reset is not None and not (scenes or scenarios):
        raise CommandError(
            "--reset is only allowed with --scene or --scenario; a suite defines its own"
        )
    if suite is not None:
        if scenes or scenarios:
            raise CommandError("give either scenes and scenarios, or a suite")
        return load_suite(suite)
    if scenes or scenarios:
        return cases_as_recorded(scenes, scenarios, _options(reset))
    if not demo:
        raise CommandError("nothing to drive: give --scene, --scenario or --suite")
    return load_suite(DEMO_SUITE)


def _options(reset: str | None) -> dict[str, Any]:
    try:
        options = json.loads(reset or "{}")
    except ValueError as error:
        raise CommandError(f"--reset is not JSON: {error}") from error
    if not isinstance(options, dict):
        raise CommandError("--reset is not a JSON object of options")
    return options


@contextlib.contextmanager
def _own_worker(scenes: Path | None, out: Path) -> Iterator[str]:
    """Start a worker with the bundles in ``scenes``, or with the demo's street; return its URL."""
    import real2sim

    from ..demo.run import worker_process
    from ..demo.street import unpack_street
    from ..scene.io import DEMO_SCENE

    with contextlib.ExitStack() as stack:
        if scenes is None:
            scenes = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="real2sim-")))
            unpack_street(scenes, DEMO_SCENE)
        worker = stack.enter_context(
            worker_process(scenes=scenes, data=out / "worker", log_file=out / "worker.log")
        )
        with real2sim.connect(worker.url) as client:
            client.wait_ready()
        yield worker.url


def _print_scores(results: Sequence[EpisodeResult]) -> None:
    from ..policies.page import group_scores

    groups = [group for group in group_scores(results) if group.case is None]
    table = Table(title="mean over cases and seeds", title_justify="left")
    table.add_column("score")
    for group in groups:
        table.add_column(escape(group.policy), justify="right", overflow="fold")
    for name in groups[0].scores:
        scores = [group.scores[name] for group in groups]
        table.add_row(name, *("–" if s is None else f"{s.mean:.3g}" for s in scores))
    at_fault = ("–" if group.failed else str(group.at_fault) for group in groups)
    table.add_row("collisions at fault", *at_fault)
    table.add_row("failed episodes", *(f"{g.failed} of {g.episodes}" for g in groups))
    console.print(table)


def _print_what_ran_once(grid: EpisodeGrid) -> None:
    fixed = [case.name for case in grid.cases if not case.is_random]
    if fixed and len(grid.seeds) > 1:
        console.print(
            f"driven once, not with {len(grid.seeds)} seeds: {', '.join(fixed)}; nothing in an "
            "episode is random but the jitter of a suite's case, and randomization and "
            "agents.spawn of its reset",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )


# --- train-policy ---------------------------------------------------------------------------------


@command("train-policy")
def train_policy(
    *,
    sources: Annotated[
        list[Path],
        typer.Argument(help="Scene bundle, driving log, or data sets of export-dataset."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Weights to write (.safetensors).")],
    camera: Annotated[
        str | None, typer.Option(help="Camera; default: the most forward-facing.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, max=100_000, help="Training epochs.")] = 60,
    shifted: Annotated[
        int,
        typer.Option(min=0, max=100, help="Rendered views off the path per frame of a scene."),
    ] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the training.")] = 0,
    log_format: LogFormat = None,
    sequence: SequenceName = None,
    json: JsonFile = None,
) -> None:
    """Train a small network to imitate the recorded driving, for --planner learned=FILE."""
    from ..policies.cloning import save_policy, train_network

    start = time.perf_counter()
    with staged_progress() as report:
        shape, dataset = _examples(
            sources,
            report,
            camera=camera,
            shifted=shifted,
            seed=seed,
            log_format=log_format,
            sequence=sequence,
        )
        weights, figures = train_network(
            dataset,
            shape,
            epochs=epochs,
            seed=seed,
            on_progress=lambda done, total: report("learn", done, total),
        )
    save_policy(weights, shape, out)
    figures |= {"examples": len(dataset.images), "seconds": time.perf_counter() - start}
    print_figures(f"policy for camera {shape.camera}", figures)
    write_json(json, figures)


def _examples(
    sources: list[Path],
    report: Callable[[str, int, int], None],
    *,
    camera: str | None,
    shifted: int,
    seed: int,
    log_format: str | None,
    sequence: str | None,
) -> tuple[PolicyShape, CloningDataset]:
    from ..policies.cloning import (
        build_dataset,
        exported_examples,
        exported_shape,
        is_export,
        log_images,
        scene_images,
    )
    from ..scene.io import DEMO_SCENE, open_scene
    from ..scene.io.packed import PACKED_SUFFIX

    if all(is_export(source) for source in sources):
        shape = exported_shape(sources[0], camera)
        read = partial(report, "read")
        return shape, exported_examples(sources, shape, on_progress=read)
    if len(sources) > 1:
        raise CommandError("several sources must all be data sets that export-dataset has written")
    (source,) = sources
    packed = source.name.endswith(PACKED_SUFFIX)
    if (source / "scene.json").is_file() or packed or str(source) == DEMO_SCENE:
        scene = open_scene(source)
        ego, shape = scene.ego, _policy_shape(scene.rig, camera)
        images = scene_images(scene, shape, shifted=shifted, seed=seed)
    else:
        log = opened_log(source, log_format, sequence)
        ego, shape = log.ego, _policy_shape(log.rig, camera)
        images = log_images(log, shape)
    return shape, build_dataset(ego, shape, _with_progress(images, report))


def _policy_shape(rig: CameraRig, camera: str | None) -> PolicyShape:
    from real2sim.planners.learned import PolicyShape

    if camera is not None and camera not in rig.names:
        raise CommandError(f"no camera {camera!r}; there are {', '.join(rig.names)}")
    ahead = max(rig, key=lambda one: one.T_vehicle_camera[0, 2]).name
    return PolicyShape(camera=camera or ahead)


def _with_progress(
    images: Iterable[PosedImage], report: Callable[[str, int, int], None]
) -> Iterator[PosedImage]:
    for done, image in enumerate(images, start=1):
        report("look", done, image.count)
        yield image
