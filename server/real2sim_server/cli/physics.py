"""Commands of the physics."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import JsonFile, app, run_command


@app.command()
def validate(
    backend: Annotated[str, typer.Option(help="cpu or reference")] = "cpu",
    cases: Annotated[
        str | None, typer.Option(help="Names with commas between them; all by default.")
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="HTML page to write; default: beside the figures.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Hold the physics to cases with known answers; exit code 1 when a line fails."""
    from . import validate as command

    run_command(command.run, backend=backend, cases=cases, page=page, json_path=json)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene bundle.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for film, curves, result.")],
    experiment: Annotated[
        str | None, typer.Option(help="Of the paper: wall, pair or drop.")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help="paper (soft) or vehicle (kilograms, crush, tyres).")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(min=0.01, max=100, help="Of an experiment [m/s].")
    ] = None,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="What takes part; repeat it.")
    ] = None,
    duration: Annotated[float | None, typer.Option(min=0.01, max=600, help="[s]")] = None,
    frame: Annotated[int, typer.Option(min=0, help="Recorded frame to start at.")] = 0,
    backend: Annotated[str, typer.Option(help="Of the solver.")] = "auto",
    max_particles: Annotated[
        int | None, typer.Option(min=100, help="Of all bodies; fewer are coarser and faster.")
    ] = None,
    film: Annotated[bool, typer.Option(help="Draw film and stills.")] = True,
    json: JsonFile = None,
) -> None:
    """Let objects of a scene collide, deform and come to rest; leave film and curves."""
    from . import simulate as command

    run_command(
        command.run,
        scene=scene,
        out=out,
        asked=command.Asked(
            experiment=experiment,
            preset=preset,
            speed=speed,
            objects=tuple(objects or ()),
            duration=duration,
            frame=frame,
            backend=backend,
            film=film,
            max_particles=max_particles,
        ),
        json_path=json,
    )


@app.command()
def ground(
    scene: Annotated[Path, typer.Argument(help="Scene bundle.")],
    log: Annotated[Path | None, typer.Option(help="Its driving log, for LiDAR.")] = None,
    frame: Annotated[int, typer.Option(min=0, help="Whose boxes are projected down.")] = 0,
    picture: Annotated[Path | None, typer.Option(help="PNG with inliers in red.")] = None,
    json: JsonFile = None,
) -> None:
    """Find the road surface under a scene's objects, from LiDAR and from Gaussians."""
    from . import ground as command

    run_command(command.run, scene=scene, log=log, frame=frame, picture=picture, json_path=json)
