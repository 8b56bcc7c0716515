"""``real2sim run``: drive through a scenario file, or a corner case of the gallery."""

from __future__ import annotations

import contextlib
import json as json_format
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..console import CommandError, console, print_figures, staged_progress, write_json
from .command import command
from .options import JsonFile

if TYPE_CHECKING:
    from real2sim_proto.storyboard import Storyboard

    from ..scene import Scene
    from ..sweeps.episode import Driven
    from ..world.agents import Event
    from ..world.recording.recording import Recording

SCRIPTED = "storyboard"
"""The planner's name where the storyboard drives the ego itself."""


@command("run")
def run(
    *,
    file: Annotated[
        str, typer.Argument(help="OpenSCENARIO file (.xosc), storyboard (.json) or gallery:NAME.")
    ],
    scene: Annotated[
        Path | None,
        typer.Argument(
            help="Scene bundle, or demo_street; default: a flat scene made from the file's roads."
        ),
    ] = None,
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
    ego: Annotated[str | None, typer.Option(help="Name of the ego entity; default: Ego.")] = None,
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
    from ..scenarios.flat_scene import fitted_to_scene
    from ..sweeps.episode import recording_of
    from ..world.recording.recording import save_recording

    board, road_file, notes = _storyboard(file, values or [], frozenset(leave_out or ()), ego)
    if speed is not None:
        board = _with_speed(board, speed)
    if export is not None:
        _export(board, export)
    for note in notes:
        console.print(f"note: {note}", markup=False, highlight=False)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="real2sim-")))
        report = stack.enter_context(staged_progress())
        report("scene", 0, 1)
        loaded = _scene(scene, board, road_file, scene_out or folder / "scene")
        if scene is not None and any(e.kind == "ego" and e.box for e in board.entities):
            console.print("note: the ego is the scene's vehicle, and not the file's")
        if not as_it_is and (scene is not None or road_file is None):
            board = fitted_to_scene(board, loaded)
        report("scene", 1, 1)
        board = board.model_copy(update={"drives_ego": planner == SCRIPTED})
        driven, events = _drive(loaded, board, planner, seed=seed, seconds=seconds)
        if save is not None or video is not None:
            recording = recording_of(loaded, driven)
            if save is not None:
                save_recording(recording, save)
            if video is not None:
                _film(recording, loaded, video, camera)
    figures = _figures(driven, events)
    _print(file, figures)
    write_json(json, figures)


def _storyboard(
    file: str, values: list[str], leave_out: frozenset[str], ego: str | None
) -> tuple[Storyboard, Path | None, tuple[str, ...]]:
    """The storyboard that is named, the file of its roads, and what has no effect."""
    from real2sim_proto.storyboard import Storyboard

    from ..scenarios import ScenarioError
    from ..scenarios.gallery import corner_case
    from ..scenarios.openscenario import ReadOptions, read_openscenario

    given = _parameters(values)
    try:
        if file.startswith("gallery:"):
            return corner_case(file).storyboard(**given), None, ()
        if file.endswith(".json"):
            fields = json_format.loads(Path(file).read_text(encoding="utf-8"))
            fields["parameters"] = {**fields.get("parameters", {}), **given}
            return Storyboard.model_validate(fields), None, ()
        found = read_openscenario(Path(file), ReadOptions(given, leave_out, ego))
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


def _scene(bundle: Path | None, board: Storyboard, road_file: Path | None, made: Path) -> Scene:
    """The scene to drive in; a flat one is written to ``made`` first, so that it has a hash."""
    from ..maps import MapError
    from ..scenarios import ScenarioError
    from ..scenarios.flat_scene import flat_scene
    from ..scene.io import load_scene, save_scene
    from ..sweeps.spec import open_scene
    from ..world import WorldError

    if bundle is not None:
        return open_scene(str(bundle))
    try:
        flat = flat_scene(board, road_file)
    except (ScenarioError, MapError, WorldError) as error:
        raise CommandError(str(error)) from error
    for note in flat.lanes.notes if flat.lanes is not None else ():
        console.print(f"note: {note}", markup=False, highlight=False)
    save_scene(flat, made)
    return load_scene(made)


def _drive(
    scene: Scene, board: Storyboard, planner: str, *, seed: int, seconds: float
) -> tuple[Driven, list[Event]]:
    """The episode, and what happened in it."""
    from real2sim.planners import load_planner

    from ..sweeps.episode import Drive, drive_episode
    from ..sweeps.spec import run_options

    driver: Any = _Scripted() if planner == SCRIPTED else load_planner(planner)
    options = run_options(board, seed=seed, seconds=seconds)
    events: list[Event] = []
    driven = drive_episode(
        scene,
        Drive(planner, options),
        driver,
        keep_entries=True,
        on_world=lambda world: events.extend(world.observe().events),
    )
    if driven.error is not None or driven.world is None:
        raise CommandError(driven.error or "the episode could not begin")
    return driven, events


class _Scripted:
    """Plans that are of no account, where the storyboard drives the ego."""

    def __init__(self) -> None:
        from real2sim.planners.planner import Needs

        self.needs = Needs()

    def reset(self, obs: Any) -> None:
        """Nothing is to be forgotten."""

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
    rows = {
        f"{e['t']:.2f} s": f"{e['what'].split('::')[-1]} {e['change'] or e['type']}"
        for e in figures["events"]
    }
    print_figures(f"{Path(file).name}: {figures['seconds']:.1f} s, {figures['reason']}", rows)
