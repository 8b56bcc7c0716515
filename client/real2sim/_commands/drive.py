"""``real2sim drive``: run a planner in the loop and report its timing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .options import (
    DEFAULT_URL,
    JsonFile,
    Timeout,
    Token,
    Url,
    connected,
    console,
    json_object,
    write_json,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from real2sim import Observation
    from real2sim.planners import EpisodeSummary

app = typer.Typer()


@app.command()
def drive(
    *,
    scene: Annotated[str | None, typer.Option(help="Name of a scene.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Id of a scenario.")] = None,
    session: Annotated[
        str | None,
        typer.Option(
            metavar="ID",
            help="Drive this existing session, for example one of the studio; it stays open.",
        ),
    ] = None,
    session_token: Annotated[
        str | None,
        typer.Option(help="Token of --session.", envvar="REAL2SIM_SESSION_TOKEN", show_envvar=True),
    ] = None,
    planner: Annotated[
        str,
        typer.Option(
            help="Planner: follow_route, pid, idm, depth_sampling, learned=FILE, neuroncap=URL, "
            "alpasim=HOST:PORT, carla=FILE, or 'module:Class'."
        ),
    ] = "follow_route",
    steps: Annotated[int, typer.Option(min=1, help="Maximum number of steps.")] = 100,
    cameras: Annotated[str, typer.Option(help="Comma-separated camera names, or 'all'.")] = "",
    width: Annotated[
        int | None, typer.Option(min=16, help="Image width [px]; default: as recorded.")
    ] = None,
    codec: Annotated[str, typer.Option(help="Image encoding: auto, raw, jpeg or png.")] = "auto",
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the episode; default: 0.")
    ] = None,
    dt_us: Annotated[int | None, typer.Option(help="Time step [us]; default: 100000.")] = None,
    warmup_us: Annotated[
        int | None,
        typer.Option(
            min=0, help="Follow the recording for this long before the planner takes over [us]."
        ),
    ] = None,
    beyond_log: Annotated[
        str | None,
        typer.Option(
            help="After the end of the recording: 'end' the episode (default), 'loop' or 'extend'."
        ),
    ] = None,
    spawn: Annotated[
        str | None,
        typer.Option(
            metavar="JSON",
            help="Spawn road users along the route: JSON of agents.spawn, for example "
            "'{\"density\": 30}'; '{}' uses the defaults.",
        ),
    ] = None,
    randomization: Annotated[
        str | None,
        typer.Option(
            metavar="JSON",
            help='Randomization of reset, sampled with --seed, as JSON, for example \'{"start": '
            '{"lateral": 0.5}}\'.',
        ),
    ] = None,
    reset: Annotated[
        str | None,
        typer.Option(
            metavar="JSON",
            help='Any other options of reset, for example \'{"ego": {"tracker": "lqr"}}\'. They '
            "override the planner's needs. Give an option here or by its own flag, not both.",
        ),
    ] = None,
    lidar: Annotated[
        str, typer.Option(help="Comma-separated LiDAR models of the worker's catalogue.")
    ] = "",
    radar: Annotated[
        str, typer.Option(help="Comma-separated radar models of the worker's catalogue.")
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for CAMERA/STEP.jpg, LIDAR/STEP.ply and summary.json."),
    ] = None,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 60.0,
    json_file: JsonFile = None,
) -> None:
    """Drive a scene or scenario with a planner."""
    from real2sim.planners import load_planner, needs_of, run_episode

    if sum(given is not None for given in (scene, scenario, session)) != 1:
        raise typer.BadParameter("give exactly one of --scene, --scenario and --session")
    flags = {
        "--seed": ("seed", seed),
        "--dt-us": ("dt_us", dt_us),
        "--warmup-us": ("warmup_us", warmup_us),
        "--beyond-log": ("beyond_log", beyond_log),
        "--randomization": (
            "randomization",
            None if randomization is None else json_object("--randomization", randomization),
        ),
        "--lidar": ("lidars", _names(lidar) or None),
        "--radar": ("radars", _names(radar) or None),
        "--cameras": ("sensors", _names(cameras) or None),
        "--width": ("sensors", width),
    }
    options = _reset_options(reset, flags, spawn)
    driver = load_planner(planner)
    needs = needs_of(driver)
    with (
        connected(url, token, timeout) as client,
        _opened(_named(client, session, session_token, scene, scenario, codec)) as opened,
    ):
        names = opened.cameras if cameras == "all" else _names(cameras)
        sensors = _sensors(names, width, needs.sensors(opened.welcome.cameras))
        with _progress(steps) as advance, _saver(out) as save:

            def on_observation(obs: Observation) -> None:
                save(obs)
                advance(obs)

            summary = run_episode(
                opened,
                driver,
                steps=steps,
                on_observation=on_observation,
                **{"sensors": sensors} | options,
            )
    _report(summary, out=out, json_file=json_file)


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


def _reset_options(
    reset: str | None, flags: Mapping[str, tuple[str, Any]], spawn: str | None
) -> dict[str, Any]:
    """Options of reset, from ``--reset`` and from the flags that were passed.

    Raises:
        typer.BadParameter: not a JSON object, or an option that was passed twice.
    """
    options = json_object("--reset", reset)
    agents = options.get("agents", {})
    for flag, (name, value) in flags.items():
        if value is None:
            continue
        if name in options:
            raise typer.BadParameter(f"{name} is set by both {flag} and --reset; set it once")
        if name != "sensors":
            options[name] = value
    if spawn is not None:
        if "spawn" in agents:
            raise typer.BadParameter("agents.spawn is set by both --spawn and --reset; set it once")
        options["agents"] = {**agents, "spawn": json_object("--spawn", spawn)}
    return options


def _sensors(
    names: list[str], width: int | None, needed: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Sensor specs: the planner's cameras, and rgb for the cameras in ``names``.

    ``width`` applies to every camera, except those that only the planner uses and for which it
    requires another width.
    """
    sensors = {s["camera"]: s | {"width": s["width"] or width} for s in needed}
    for name in names:
        sensor = sensors.setdefault(name, {"camera": name, "modalities": [], "width": None})
        both = {*sensor["modalities"], "rgb"}
        # A camera has one image size, for the planner and for saved images.
        sensors[name] = sensor | {"modalities": sorted(both), "width": width or sensor["width"]}
    return list(sensors.values())


def _named(  # noqa: PLR0917, one for each way to name a session
    client: Any,
    session: str | None,
    token: str | None,
    scene: str | None,
    scenario: str | None,
    codec: str,
) -> Any:
    """A new session, or an existing one if ``session`` is set."""
    if session is None:
        return client.session(scene=scene, scenario=scenario, codec=codec)
    return client.join(session, token=token or "", codec=codec)


@contextlib.contextmanager
def _opened(session: Any) -> Iterator[Any]:
    from rich.console import Console

    with Console(stderr=True).status("the worker opens the session"):
        session.open()
    try:
        yield session
    finally:
        session.close()


@contextlib.contextmanager
def _progress(steps: int) -> Iterator[Callable[[Observation], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (TextColumn("driving"), BarColumn(), MofNCompleteColumn(), Remaining())
    columns_end = TextColumn("{task.fields[speed]:.1f} m/s")
    with Progress(*columns, columns_end, console=Console(stderr=True)) as progress:
        task = progress.add_task("driving", total=steps, speed=0.0)
        yield lambda obs: progress.update(task, completed=obs.step, speed=obs.ego.speed)


@contextlib.contextmanager
def _saver(folder: Path | None) -> Iterator[Callable[[Observation], None]]:
    if folder is None:
        yield lambda _obs: None
        return
    # Encode and write in threads, to keep this work out of the measured loop.
    with ThreadPoolExecutor(2) as pool:
        pending = []

        def save(obs: Observation) -> None:
            for camera, modalities in obs.frames.items():
                if "rgb" in modalities:
                    path = folder / camera / f"{obs.step:06d}.jpg"
                    pending.append(pool.submit(modalities["rgb"].save, path))
            for sensor, cloud in obs.clouds.items():
                path = folder / sensor / f"{obs.step:06d}.ply"
                pending.append(pool.submit(cloud.save, path))

        yield save
        for future in pending:
            future.result()


def _report(summary: EpisodeSummary, *, out: Path | None, json_file: Path | None) -> None:
    figures = summary.to_dict()
    if out is not None:
        write_json(out / "summary.json", figures)
    if json_file is not None:
        write_json(json_file, figures)
    if json_file is None or str(json_file) != "-":
        _print_summary(console(), summary)


def _print_summary(out: Console, summary: EpisodeSummary) -> None:
    from rich.table import Table

    ending = summary.reason or ("over" if summary.terminated or summary.truncated else "steps done")
    out.print(
        f"{summary.steps} steps, {(summary.end_us - summary.start_us) * 1e-6:.1f} s, "
        f"{summary.distance:.1f} m; ended: {ending}; {summary.steps_per_second:.1f} steps/s",
        highlight=False,
    )
    for event in summary.events:
        subject = event.object_id or f"{event.element or ''} {event.change or ''}".strip()
        what = f"{event.type} {subject}".strip()
        out.print(f"{(event.t_us - summary.start_us) * 1e-6:8.1f} s  {what}", highlight=False)
    table = Table(box=None, pad_edge=False)
    table.add_column("milliseconds")
    for heading in ("p50", "p95", "p99", "mean"):
        table.add_column(heading, justify="right")
    for stage, times in summary.stages.items():
        figures = (times.p50, times.p95, times.p99, times.mean)
        table.add_row(stage, *(f"{figure:.2f}" for figure in figures))
    out.print(table)
