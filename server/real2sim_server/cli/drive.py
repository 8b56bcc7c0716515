"""Commands that drive without a worker, and the gallery: run, gallery, replay, sweep, search."""

from __future__ import annotations

import contextlib
import json as json_format
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from ..console import (
    CommandError,
    console,
    print_figures,
    reported_progress,
    staged_progress,
    write_json,
)
from .common import Follow, JsonFile, PlanLimit, command

if TYPE_CHECKING:
    from real2sim_proto.storyboard import Storyboard

    from ..scenarios.gallery import CornerCase
    from ..scenarios.openscenario import ReadOptions
    from ..scene import Scene
    from ..sweeps.episode import Driven
    from ..world import World
    from ..world.agents import Event
    from ..world.recording import Recording
    from ..world.replay import Replayer


ScenesFolder = Annotated[Path | None, typer.Option("--scenes", help="Folder of scene bundles.")]


# --- run ------------------------------------------------------------------------------------------

SCRIPTED = "storyboard"
"""Name of the planner if the storyboard drives the ego."""


@command("run")
def run(
    *,
    file: Annotated[
        str, typer.Argument(help="OpenSCENARIO file (.xosc), storyboard (.json) or gallery:NAME.")
    ],
    scene: Annotated[
        str | None,
        typer.Argument(
            help="Scene bundle, or demo_street; default: a flat scene made from the file's roads."
        ),
    ] = None,
    scenes: ScenesFolder = None,
    planner: Annotated[
        str, typer.Option(help="Planner as for evaluate-policy; 'storyboard' scripts the ego too.")
    ] = SCRIPTED,
    values: Annotated[
        list[str] | None, typer.Option("--set", help="Parameter as NAME=VALUE; repeatable.")
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option("--leave-out", help="Element of the file to ignore; repeatable."),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse elements that have no effect on the drive.")
    ] = False,
    ego: Annotated[str | None, typer.Option(help="Name of the ego entity; default: Ego.")] = None,
    roads: Annotated[
        Path | None,
        typer.Option(exists=True, help="OpenDRIVE file to use as the road network of the file."),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.1, max=3600, help="Maximum duration [s].")] = 30.0,
    speed: Annotated[
        float | None,
        typer.Option(min=0, max=60, help="Initial speed of the ego [m/s]; default: from the file."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of random distributions.")] = 0,
    save: Annotated[Path | None, typer.Option("--save", help="Recording (.r2e) to write.")] = None,
    as_it_is: Annotated[
        bool, typer.Option("--as-it-is", help="Use the file's coordinates unchanged.")
    ] = False,
    scene_out: Annotated[
        Path | None, typer.Option(help="Write the generated flat scene to this bundle, for replay.")
    ] = None,
    video: Annotated[
        Path | None, typer.Option("--video", help="Video (MP4 or WebM) to write.")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="Camera of the video; default: the first.")
    ] = None,
    export: Annotated[
        Path | None, typer.Option("--export", help="Also export it as OpenSCENARIO 1.3 (.xosc).")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Run a scenario file with a planner and report what happened."""
    from real2sim_proto.storyboard import MapRoads

    from ..scenarios.flat_scene import fitted_to_scene
    from ..scenarios.openscenario import ReadOptions
    from ..scene.io import open_scene
    from ..sweeps.episode import recording_of
    from ..world.recording import save_recording

    options = ReadOptions(_parameters(values or []), frozenset(leave_out or ()), ego, strict)
    board, road_file, notes = _storyboard(file, options)
    if roads is not None and not isinstance(board.roads, MapRoads):
        raise CommandError(f"--roads: {file} names no road network that could be replaced")
    road_file = roads or road_file
    if speed is not None:
        board = _with_speed(board, speed)
    if export is not None:
        _export(board, export)
    if planner != SCRIPTED and (taken := _ego_actions(board)):
        notes += (f"the planner drives: {taken} scripted actions of the ego end at once",)
    for note in notes:
        console.print(f"note: {note}", markup=False, highlight=False)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="real2sim-")))
        report = stack.enter_context(staged_progress())
        report("scene", 0, 1)
        if scene is not None:
            loaded = open_scene(scene, scenes)
        else:
            loaded = _flat_scene(board, road_file, scene_out or folder / "scene")
        if scene is not None and any(e.kind == "ego" and e.box for e in board.entities):
            console.print("note: the ego is the scene's vehicle, and not the file's")
        if not as_it_is and (scene is not None or road_file is None):
            board = fitted_to_scene(board, loaded)
        report("scene", 1, 1)
        board = board.model_copy(update={"drives_ego": planner == SCRIPTED})
        driven, events = _drive(loaded, board, planner, report, seed=seed, seconds=seconds)
        if save is not None or video is not None:
            recording = recording_of(loaded, driven)
            if save is not None:
                save_recording(recording, save)
            if video is not None:
                report("video", 0, 1)
                _film(recording, loaded, video, camera)
    figures = _figures(driven, events)
    _print(file, figures)
    write_json(json, figures)


def _ego_actions(board: Storyboard) -> int:
    """Number of actions of the stories that move the ego."""
    from real2sim_proto.storyboard import story_actions

    from ..world.storyboard.progress import GLOBAL

    egos = {entity.name for entity in board.entities if entity.kind == "ego"}
    return sum(
        not isinstance(action, GLOBAL) and not egos.isdisjoint(names)
        for names, action in story_actions(board)
    )


def _storyboard(file: str, options: ReadOptions) -> tuple[Storyboard, Path | None, tuple[str, ...]]:
    """The named storyboard, its road file, and elements without effect."""
    from real2sim_proto.storyboard import Storyboard

    from .._files import read_text
    from ..scenarios import ScenarioError
    from ..scenarios.gallery import corner_case
    from ..scenarios.openscenario import read_openscenario

    try:
        if file.startswith("gallery:"):
            return corner_case(file).storyboard(**options.parameters), None, ()
        if file.lower().endswith(".json"):
            fields = json_format.loads(read_text(Path(file)))
            fields["parameters"] = {**fields.get("parameters", {}), **options.parameters}
            return Storyboard.model_validate(fields), None, ()
        found = read_openscenario(Path(file), options)
    except (ScenarioError, ValueError, OSError) as error:
        raise CommandError(str(error)) from error
    if len(found.cases) > 1:
        console.print(f"note: the first of {len(found.cases)} cases of its distribution")
    return found.board, found.road_file, found.notes


def _export(board: Storyboard, path: Path) -> None:
    from .._files import atomic_file
    from ..scenarios import ScenarioError
    from ..scenarios.openscenario import write_openscenario

    try:
        content = write_openscenario(board)
    except ScenarioError as error:
        raise CommandError(str(error)) from error
    with atomic_file(path) as file:
        file.write(content)
    console.print(f"wrote {path}", highlight=False)


def _parameters(values: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for text in values:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise CommandError(f"--set {text!r}; allowed is name=value, such as gap=12")
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = value
    return found


def _with_speed(board: Storyboard, speed: float) -> Storyboard:
    from real2sim_proto.storyboard import InitAction, Storyboard
    from real2sim_proto.storyboard_actions import SpeedAction

    ego = next((e.name for e in board.entities if e.kind == "ego"), None)
    if ego is None:
        raise CommandError("--speed is the ego's, and the scenario has no ego")
    kept = [e for e in board.init if not (e.entity == ego and e.action.kind == "speed")]
    fields = board.model_dump()
    added = InitAction(entity=ego, action=SpeedAction(speed=speed))
    fields["init"] = [e.model_dump() for e in (*kept, added)]
    return Storyboard.model_validate(fields)


def _flat_scene(board: Storyboard, road_file: Path | None, made: Path) -> Scene:
    """A flat scene of the storyboard's roads, written to ``made`` to give it a hash."""
    from ..maps import MapError
    from ..scenarios import ScenarioError
    from ..scenarios.flat_scene import flat_scene, positions_off_roads
    from ..scene.io import load_scene, save_scene
    from ..world import WorldError

    try:
        flat = flat_scene(board, road_file)
    except (ScenarioError, MapError, WorldError) as error:
        raise CommandError(str(error)) from error
    if flat.lanes is not None:
        for note in (*flat.lanes.notes, *positions_off_roads(board, flat.lanes)):
            console.print(f"note: {note}", markup=False, highlight=False)
    save_scene(flat, made)
    return load_scene(made)


def _drive(
    scene: Scene,
    board: Storyboard,
    planner: str,
    report: Callable[..., None],
    *,
    seed: int,
    seconds: float,
) -> tuple[Driven, list[Event]]:
    """Drive the episode and return it with its events."""
    from real2sim.planners import load_planner

    from ..sweeps.episode import Drive, drive_episode
    from ..sweeps.spec import run_options

    driver: Any = _Scripted() if planner == SCRIPTED else load_planner(planner)
    options = run_options(board, seed=seed, seconds=seconds)
    events: list[Event] = []

    def follow(world: World) -> None:
        events.extend(world.observe().events)
        report("drive", world.steps, options["horizon"])

    driven = drive_episode(
        scene,
        Drive(planner, options),
        driver,
        keep_entries=True,
        on_world=follow,
    )
    if driven.error is not None or driven.world is None:
        raise CommandError(driven.error or "the episode could not begin")
    return driven, events


class _Scripted:
    """Placeholder planner: its plans are ignored, because the storyboard drives the ego."""

    def __init__(self) -> None:
        from real2sim.planners.planner import Needs

        self.needs = Needs()

    def reset(self, obs: Any) -> None:
        """Nothing to reset."""

    def plan(self, obs: Any) -> dict[str, Any]:
        times, poses = [obs.t_us + 1_000_000], [(0.0, 0.0, 0.0)]
        return {"kind": "trajectory", "times_us": times, "poses": poses}


def _film(recording: Recording, scene: Scene, video: Path, camera: str | None) -> None:
    from ..policies.page import film_episode

    film_episode(recording, recording.replayer(scene), scene, video, camera=camera)
    console.print(f"wrote {video}", highlight=False)


def _figures(driven: Driven, events: list[Event]) -> dict[str, Any]:
    world = driven.world
    assert world is not None
    start = world.t_us - world.steps * world.spec.dt_us
    happened = [
        {
            "t": round((e.t_us - start) * 1e-6, 6),
            "type": e.type,
            "what": e.element or e.object_id or "",
            "change": e.change,
        }
        for e in events
        if e.type != "storyboard" or e.element_type == "event"
    ]
    return {
        "steps": world.steps,
        "seconds": (world.t_us - start) * 1e-6,
        "reason": world.reason,
        "events": happened,
        "metrics": world.metrics(),
    }


def _print(file: str, figures: dict[str, Any]) -> None:
    rows: dict[str, str] = {}
    for e in figures["events"]:
        time, what = f"{e['t']:.2f} s", f"{e['what'].split('::')[-1]} {e['change'] or e['type']}"
        # Several events may happen at one instant.
        rows[time] = f"{rows[time]}\n{what}" if time in rows else what
    print_figures(f"{Path(file).name}: {figures['seconds']:.1f} s, {figures['reason']}", rows)


# --- gallery --------------------------------------------------------------------------------------


@command("gallery")
def gallery(
    *,
    name: Annotated[
        str | None, typer.Argument(help="Case to print as a storyboard; default: list all cases.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Write the case to this OpenSCENARIO file (.xosc) instead."),
    ] = None,
    json: JsonFile = None,
) -> None:
    """List the corner cases that `run gallery:NAME` drives, or print one of them.

    A printed case is a storyboard in JSON, which `run` drives from a file.
    """
    from real2sim._calls import sent_fields

    from ..scenarios.gallery import FAMILIES, GALLERY, corner_case

    if name is None:
        if out is not None:
            raise CommandError(f"--out writes a single case; name one of {', '.join(GALLERY)}")
        for family, tests in FAMILIES.items():
            columns = ("name", "what happens", "parameters")
            table = Table(*columns, title=f"{family}: {tests}", title_justify="left")
            for case in (c for c in GALLERY.values() if c.family == family):
                values = ", ".join(f"{p} {value:g}" for p, value in case.parameters.items())
                table.add_row(case.name, case.title, values)
            console.print(table)
        write_json(json, {"cases": [_case_fields(case) for case in GALLERY.values()]})
        return
    try:
        case = corner_case(name)
    except ValueError as error:
        raise CommandError(str(error)) from error
    board = case.storyboard()
    fields = sent_fields(board)
    if out is not None:
        _export(board, out)
    else:
        typer.echo(json_format.dumps(fields, indent=2))
    write_json(json, {**_case_fields(case), "storyboard": fields})


def _case_fields(case: CornerCase) -> dict[str, Any]:
    from ..scenarios.gallery import FAMILIES

    return {
        "name": case.name,
        "title": case.title,
        "family": case.family,
        "tests": FAMILIES[case.family],
        "parameters": dict(case.parameters),
    }


# --- replay ---------------------------------------------------------------------------------------


@command("replay")
def replay(
    *,
    episode: Annotated[Path, typer.Argument(help="Recording of an episode (.r2e).")],
    scene: Annotated[
        str | None,
        typer.Option("--scene", help="Scene bundle, or demo_street; simulates the episode again."),
    ] = None,
    scenes: ScenesFolder = None,
    assets: Annotated[
        Path | None, typer.Option("--assets", help="Asset library of the scenario.")
    ] = None,
    mcap: Annotated[Path | None, typer.Option("--mcap", help="Also write an MCAP file.")] = None,
    video: Annotated[Path | None, typer.Option("--video", help="Video (MP4) to write.")] = None,
    camera: Annotated[
        str | None, typer.Option(help="Camera of the video; default: the first.")
    ] = None,
    width: Annotated[int, typer.Option(min=64, max=4096, help="Width of the video [px].")] = 640,
    json: JsonFile = None,
) -> None:
    """Score a recorded episode; with its scene, verify and film it."""
    from ..policies.page import film_episode
    from ..world.mcap_file import save_mcap
    from ..world.recording import first_difference, load_recording

    recording = load_recording(episode)
    figures: dict[str, object] = {
        "steps": len(recording.instants) - 1,
        "recorded_metrics": recording.metrics,
        "scores": [score.fields() for score in recording.rescore()],
    }
    if scene is not None:
        loaded = _load_its_scene(recording, scene, scenes)
        start = _replay_factory(recording, loaded, assets)
        difference = first_difference(recording, start())
        figures["bit_identical"] = difference is None
        figures["first_difference"] = difference
        if video is not None:
            film_episode(recording, start(), loaded, video, camera=camera, width=width)
            console.print(f"wrote {video}")
    elif video is not None:
        raise CommandError("--video draws the scene; name it with --scene")
    if mcap is not None:
        save_mcap(recording, mcap)
        console.print(f"wrote {mcap}")
    _print_scores(recording, figures)
    write_json(json, figures)
    if figures.get("bit_identical") is False:
        raise CommandError(
            f"the episode comes out differently from step {figures['first_difference']} on; it was "
            "recorded by another version of this program, or on another device"
        )


def _load_its_scene(recording: Recording, name: str, folder: Path | None) -> Scene:
    from ..scene.io import open_scene

    scene = open_scene(name, folder)
    if scene.content_hash != recording.scene_hash:
        raise CommandError(
            f"the episode ran on a scene with hash {recording.scene_hash[:12]}; {name} has "
            f"{(scene.content_hash or '')[:12]}"
        )
    return scene


def _replay_factory(
    recording: Recording, scene: Scene, assets: Path | None
) -> Callable[[], Replayer]:
    """A factory of the session in its state before the first entry."""
    from ..edit import EditError
    from ..service.library.assets import AssetLibrary
    from ..world.recording import RecordingError

    library = AssetLibrary(assets) if assets is not None else None

    def start() -> Replayer:
        try:
            return recording.replayer(scene, library.find if library else None)
        except EditError as error:
            hint = "name the folder of the worker's asset library with --assets"
            raise CommandError(f"{error}; {hint}") from error
        except RecordingError as error:
            raise CommandError(f"{error} without --scene") from error

    return start


def _print_scores(recording: Recording, figures: dict[str, object]) -> None:
    recorded = {score["name"]: score for score in recording.scores}
    rows = {}
    for score in recording.rescore():
        value = "undefined" if score.value is None else f"{score.value:.4g}"
        old = recorded.get(score.name, {})
        same = old.get("version") == score.version and old.get("value") == score.value
        rows[f"{score.name}@{score.version}"] = value if same else f"{value} (was {old})"
    if "bit_identical" in figures:
        rows["bit-identical"] = "yes" if figures["bit_identical"] else "no"
    print_figures(f"{recording.scene}, {figures['steps']} steps", rows)
    for score in recording.rescore():
        if score.cannot_see:
            console.print(f"[dim]{score.name}: {score.cannot_see}[/dim]")


# --- sweep, search --------------------------------------------------------------------------------


@command("sweep")
def sweep(
    *,
    spec: Annotated[Path, typer.Argument(help="sweep.yaml or .json, see docs/sweeps.md.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder; an existing sweep resumes.")],
    scenes: ScenesFolder = None,
    workers: Annotated[
        int, typer.Option(min=1, max=4096, help="Episodes to drive in parallel.")
    ] = 1,
    executor: Annotated[str, typer.Option(help="Run in local processes or on ray.")] = "processes",
    ray_address: Annotated[
        str | None, typer.Option(help="Address of a Ray cluster; default: start one.")
    ] = None,
    plan_limit: PlanLimit = 60.0,
    json: JsonFile = None,
    follow: Follow = False,
) -> None:
    """Drive points of a parameter space with planners; renders only what planners need.

    Writes episodes.parquet with one row per episode, and recordings and scenario files of the
    worst. If it is interrupted, run the same command again to continue. The table has the same
    bytes for any executor and any number of interruptions.
    """
    from ..console import write_json
    from ..executors import ExecutorError, executor_of
    from ..sweeps import load_sweep, run_sweep

    asked = load_sweep(spec, scenes)
    try:
        who = executor_of(executor, workers=workers, address=ray_address)
        with reported_progress(follow=follow) as report:
            figures = run_sweep(
                asked, out, who, scenes=scenes, plan_limit_s=plan_limit, on_progress=report
            )
    except ExecutorError as error:
        raise CommandError(str(error)) from error
    write_json(json, figures)
    if not follow:
        shown = {name: value for name, value in figures.items() if value is not None}
        print_figures(f"sweep of {asked.case.name}", shown)


# --- search ---------------------------------------------------------------------------------------


@command("search")
def search(
    *,
    spaces: Annotated[
        list[str],
        typer.Argument(help="Files as for `sweep`, or shipped: cut_in, hard_brake, oncoming, ..."),
    ],
    planner: Annotated[str, typer.Option(help="Planner as for `drive`, see docs/policies.md.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder; an existing search resumes.")],
    episodes: Annotated[int, typer.Option(min=20, max=100_000, help="Number of episodes.")] = 300,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0,
    shrink: Annotated[
        int, typer.Option(min=0, help="Number of failures to shrink to their boundary.")
    ] = 3,
    probability: Annotated[
        int, typer.Option(min=0, help="Episodes to estimate the failure rate; 0: none.")
    ] = 0,
    films: Annotated[int, typer.Option(min=0, help="Number of failures to film.")] = 0,
    plan_limit: PlanLimit = 60.0,
    scenes: ScenesFolder = None,
    json: JsonFile = None,
    follow: Follow = False,
) -> None:
    """Find avoidable collisions that are the planner's fault.

    Writes failures.json, each failure as a case and as a recording, and a page; see docs/sweeps.md.
    If it is interrupted, run the same command again to continue; it ends with the same result.
    """
    from ..console import write_json
    from ..sweeps import load_space
    from ..sweeps.optimise import SearchBudget
    from ..sweeps.search import SearchOptions, run_search

    options = SearchOptions(
        budget=SearchBudget(episodes=episodes, seed=seed),
        shrink=shrink,
        probability=probability,
        films=films,
        scenes=scenes,
        plan_limit_s=plan_limit,
    )
    asked = [load_space(name, scenes) for name in spaces]
    with reported_progress(follow=follow) as report:
        found = run_search(asked, planner, out, options, on_progress=report)
    write_json(json, found)
    if follow:
        return
    keys = ["episodes", "driven_now", "first_failure", "at_fault", "avoidable", "cells"]
    keys += ["planner_failed", "first_error"] if found["planner_failed"] else []
    print_figures(f"failures of {planner}", {k: found[k] for k in keys})
    console.print(f"wrote {out / 'failures.html'} and {out / 'failures.json'}")
