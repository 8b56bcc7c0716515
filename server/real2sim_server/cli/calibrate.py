"""``real2sim calibrate``: values of an object from what was seen of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, print_figures, staged_progress, write_json
from .command import command
from .options import JsonFile, SceneBundle
from .simulate import changed, continue_driving, values_of

if TYPE_CHECKING:
    from real2sim_proto.jobs import Observations

    from ..simulation.calibration import ObjectCalibration


@command("calibrate")
def calibrate(
    *,
    scene: SceneBundle,
    subject: Annotated[str, typer.Option("--object", help="Object to calibrate.")],
    fit: Annotated[
        list[str],
        typer.Option(help="stiffness, yield_stress, viscosity, friction or speed; repeatable."),
    ],
    observed: Annotated[
        Path | None,
        typer.Option(
            help="JSON of boxes, points and images, as of the REST job; images may be files beside "
            "it. Default: the object's own recorded track.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    beside: Annotated[
        list[str] | None, typer.Option("--with", help="Other objects to simulate; repeatable.")
    ] = None,
    physics: Annotated[
        list[str] | None,
        typer.Option("--physics", help="Initial values, as for simulate."),
    ] = None,
    gravity: Annotated[float | None, typer.Option(min=0, max=100, help="Gravity [m/s^2].")] = None,
    preset: Annotated[str, typer.Option(help="Preset: paper or vehicle.")] = "vehicle",
    frame: Annotated[int, typer.Option(min=0, help="Recorded frame to start at.")] = 0,
    duration: Annotated[
        float, typer.Option(min=0.01, max=30, help="Duration of the recorded track to use [s].")
    ] = 1.0,
    max_particles: Annotated[
        int, typer.Option(min=100, help="Maximum particles of all bodies.")
    ] = 20_000,
    steps: Annotated[int, typer.Option(min=1, max=60, help="Maximum steps of the search.")] = 12,
    json: JsonFile = None,
) -> None:
    """Fit an object's physical parameters to observations.

    Each comes with what it may be wrong by: what observations leave open, and what cells do.
    """
    from ..edit.state import ScenarioState
    from ..scene.io import load_scene
    from ..simulation.calibration import calibrate_object, observations_of

    given = _read(observed)
    loaded = load_scene(scene)
    state = ScenarioState.of(loaded)
    taking_part = (subject, *(beside or ()))
    setup = continue_driving(loaded, state, taking_part, frame, preset=preset)
    options = replace(
        setup.options,
        objects=changed(setup, values_of(physics or [])),
        max_particles=max_particles,
    )
    if gravity is not None:
        options = replace(options, gravity=(0.0, 0.0, -gravity))
    there = {o.object_id: o for o in state.visible}
    if subject not in there:
        raise CommandError(f"no object {subject!r}; there are {', '.join(sorted(there))}")
    end = options.start_us + round(duration * 1e6)
    seen = observations_of(given, loaded, there[subject], options.start_us, end)
    expected = 6 * len(fit) + 2 * steps + 5
    with staged_progress() as report:
        found = calibrate_object(
            loaded,
            state,
            options,
            subject,
            seen,
            parameters=fit,
            steps=steps,
            on_run=lambda runs: report("simulate", min(runs, expected), expected),
        )
    print_figures(f"{subject} of {scene.name}", _figures(found))
    write_json(json, found.figures())


def _read(path: Path | None) -> Observations:
    """Observations of a file; images that it names by their files are read."""
    import base64
    import json

    from pydantic import ValidationError

    from real2sim_proto.jobs import Observations

    if path is None:
        return Observations(recorded=True)
    try:
        document = json.loads(path.read_text("utf-8"))
        for image in document.get("images", []):
            if "file" in image:
                data = (path.parent / image.pop("file")).read_bytes()
                image["image"] = base64.b64encode(data).decode("ascii")
        return Observations.model_validate(document)
    except ValidationError as problem:
        first = problem.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise CommandError(f"{path}: {where}: {first['msg']}") from problem
    except (OSError, ValueError, AttributeError, TypeError) as problem:
        raise CommandError(f"{path}: no readable observations: {problem}") from problem


def _figures(found: ObjectCalibration) -> dict[str, object]:
    fit = found.fit
    figures: dict[str, object] = {}
    for name, factor in fit.factors.items():
        if name in fit.undetermined:
            figures[name] = "not told by these observations"
            continue
        value = f", {found.values[name]:.4g}" if name in found.values else ""
        figures[name] = f"times {factor:.3f} +- {100 * fit.uncertainty[name]:.1f} %{value}"
    figures["differences over what is known"] = f"{fit.residual[0]:.3g} to {fit.residual[-1]:.3g}"
    figures["simulations"] = fit.runs
    return figures
