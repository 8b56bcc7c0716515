"""Commands about episodes and the policies that drive them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import JsonFile, LogFormat, Sequence, app, run_command


@app.command("evaluate-policy")
def evaluate_policy(
    out: Annotated[Path, typer.Option("--out", help="Folder for report and recordings.")],
    policies: Annotated[
        list[str],
        typer.Option(
            "--policy", help="follow_route, pid, idm, depth_sampling, learned=FILE, module:Class."
        ),
    ],
    scenes: Annotated[
        list[str] | None, typer.Option("--scene", help="To drive as recorded; repeat it.")
    ] = None,
    scenarios: Annotated[
        list[str] | None, typer.Option("--scenario", help="Id, to drive as it is; repeat it.")
    ] = None,
    suite: Annotated[
        Path | None,
        typer.Option(help="JSON file of cases instead. With none: the demo's street, three ways."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="How many, from 0 on.")] = 3,
    url: Annotated[
        str | None, typer.Option(help="Of a running worker; default: one is started.")
    ] = None,
    token: Annotated[str | None, typer.Option(envvar="REAL2SIM_TOKEN", show_default=False)] = None,
    scenes_dir: Annotated[
        Path | None, typer.Option("--scenes", help="Bundles for the worker that is started.")
    ] = None,
    sessions: Annotated[int, typer.Option(min=1, max=64, help="Episodes at a time.")] = 2,
) -> None:
    """Drive cases with planners; leave scores, recordings and a page that compares them."""
    from ..policies import evaluate as command

    run_command(
        command.run,
        out=out,
        options=command.Options(
            policies=tuple(policies),
            scenes=tuple(scenes or ()),
            scenarios=tuple(scenarios or ()),
            suite=suite,
            seeds=seeds,
            url=url,
            token=token,
            scenes_dir=scenes_dir,
            sessions=sessions,
        ),
    )


@app.command("train-policy")
def train_policy(
    source: Annotated[Path, typer.Argument(help="Scene bundle, or folder of a driving log.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File of weights (.safetensors).")],
    camera: Annotated[
        str | None, typer.Option(help="Default: the one that looks most nearly ahead.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, max=100_000)] = 60,
    shifted: Annotated[
        int, typer.Option(min=0, max=100, help="Views beside the path per frame, of a scene.")
    ] = 5,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Teach a small network to drive as the recording vehicle did; for planner learned=FILE."""
    from ..policies import train as command

    run_command(
        command.run,
        source=source,
        out=out,
        asked=command.Asked(camera=camera, epochs=epochs, shifted=shifted, seed=seed),
        log_format=log_format,
        sequence=sequence,
        json_path=json,
    )


@app.command()
def replay(
    episode: Annotated[Path, typer.Argument(help="Recording of an episode (.r2e).")],
    scene: Annotated[
        Path | None, typer.Option("--scene", help="Its scene bundle: live through it again.")
    ] = None,
    assets: Annotated[
        Path | None, typer.Option("--assets", help="Asset library, for scenarios that use it.")
    ] = None,
    mcap: Annotated[
        Path | None, typer.Option("--mcap", help="Also write it for Foxglove and others.")
    ] = None,
    video: Annotated[Path | None, typer.Option("--video", help="MP4 to draw.")] = None,
    camera: Annotated[str | None, typer.Option(help="Of the video; default: the first.")] = None,
    width: Annotated[int, typer.Option(min=64, max=4096, help="Of the video [px].")] = 640,
    json: JsonFile = None,
) -> None:
    """Score a recorded episode; with its scene, check that it comes out the same, and film it."""
    from . import replay as command

    run_command(
        command.run,
        episode=episode,
        scene=scene,
        assets=assets,
        mcap=mcap,
        video=video,
        camera=camera,
        width=width,
        json_path=json,
    )
