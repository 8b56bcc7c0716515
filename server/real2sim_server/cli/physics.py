"""Physics commands: simulate, calibrate and validate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .._files import atomic_file, read_text
from ..console import CommandError, console, print_figures, progress, staged_progress, write_json
from .common import JsonFile, SceneBundle, command

if TYPE_CHECKING:
    from real2sim_proto.jobs import Observations
    from real2sim_proto.operations import PhysicsValues

    from ..physics.validation.table import CaseResult
    from ..scene import Scene
    from ..simulation.calibration import ObjectCalibration
    from ..simulation.experiments import Experiment
    from ..simulation.result import PlacedObjects, SimulationResult
    from ..simulation.structure import ObjectPhysics


# --- simulate -------------------------------------------------------------------------------------


@command("simulate")
def simulate(
    *,
    scene: SceneBundle,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Output folder for film, curves and results.")
    ],
    experiment: Annotated[
        str | None,
        typer.Option(
            help="wall, pair or drop (from the paper); frontal, t_bone, pole or roof (crash tests)."
        ),
    ] = None,
    physics: Annotated[
        list[str] | None,
        typer.Option(
            "--physics",
            help="[OBJECT:]NAME=VALUE,..., e.g. young=2e6,poisson=0.4,density=200,grid=50 for all, "
            "car_3:friction=0.2 for one; repeatable. Names: mass, material, young, poisson, "
            "density, yield_stress, friction, restitution, grid.",
        ),
    ] = None,
    gravity: Annotated[float | None, typer.Option(min=0, max=100, help="Gravity [m/s^2].")] = None,
    preset: Annotated[
        str | None, typer.Option(help="paper (soft) or vehicle (kilograms, crush, tyres).")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(min=0.01, max=100, help="Speed of the experiment [m/s].")
    ] = None,
    objects: Annotated[
        list[str] | None,
        typer.Option(
            "--object", help="Object to simulate ('ego': the recording vehicle); repeatable."
        ),
    ] = None,
    duration: Annotated[float | None, typer.Option(min=0.01, max=600, help="Duration [s].")] = None,
    frame: Annotated[int, typer.Option(min=0, help="Frame to start at.")] = 0,
    backend: Annotated[str, typer.Option(help="Solver: auto, cpu, cuda or reference.")] = "auto",
    max_particles: Annotated[
        int | None,
        typer.Option(
            min=100,
            max=4_000_000,
            help="Maximum particles of all bodies; fewer are faster and coarser.",
        ),
    ] = None,
    background: Annotated[
        bool,
        typer.Option(help="Collide with walls, poles and trees of the scene; not in experiments."),
    ] = True,
    film: Annotated[bool, typer.Option(help="Render a film and stills.")] = True,
    json: JsonFile = None,
) -> None:
    """Simulate collisions and deformation of a scene's objects; write film and curves."""
    from ..edit.state import ScenarioState
    from ..scene.io import open_scene
    from ..simulation.experiments import FilmPlan, draw_curves, set_up, views, write_film
    from ..simulation.result import Playback
    from ..simulation.rollout import simulate
    from ..simulation.spawn import EGO, with_ego

    values = values_of(physics or [])
    loaded = open_scene(scene)
    state: PlacedObjects = ScenarioState.of(loaded)
    taking_part = tuple(objects or ())
    if EGO in taking_part:
        loaded, state = with_ego(loaded, state)
    if experiment is None:
        setup = continue_driving(loaded, state, taking_part, frame, preset=preset or "vehicle")
    else:
        setup = set_up(
            experiment,
            loaded,
            state,
            preset=preset,
            speed=speed,
            objects=taking_part,
            grids=[v.grid for v in values.values() if v.grid is not None],
        )
    options = replace(
        setup.options,
        backend=backend,
        background=background and not experiment,
        objects=changed(setup, values),
    )
    if gravity is not None:
        options = replace(options, gravity=(0.0, 0.0, -gravity))
    if duration is not None:
        options = replace(options, duration=duration)
    if max_particles is not None:
        options = replace(options, max_particles=max_particles)
    out.mkdir(parents=True, exist_ok=True)
    with staged_progress() as report:
        result = simulate(
            loaded,
            state,
            options,
            on_progress=lambda done, total: report("simulate", done, total),
        )
        result.save(out / "simulation")
        draw_curves(result, out / "curves.png")
        plan = FilmPlan.of(setup, loaded.ground.height)
        plan.save(out)
        if film:
            playback = Playback(loaded, state, result)
            write_film(
                playback,
                views(playback, plan),
                out,
                slow=plan.slow,
                on_progress=lambda done, total: report("film", done, total),
            )
    figures = _figures(result)
    print_figures(f"{setup.name} on {scene.name}", figures)
    drawn = "film.mp4, strip.png, " if film else ""
    console.print(f"in {out}: {drawn}curves.png, simulation/", highlight=False)
    write_json(json, figures)


def values_of(given: list[str]) -> dict[str, PhysicsValues]:
    """Values of ``--physics`` by object; "*" means all objects."""
    from pydantic import ValidationError

    from real2sim_proto.base import invalid_reason
    from real2sim_proto.operations import PhysicsValues

    fields: dict[str, dict[str, str]] = {}
    for text in given:
        subject, colon, pairs = text.partition(":")
        own = fields.setdefault(subject if colon else "*", {})
        for pair in (pairs if colon else text).split(","):
            name, equals, value = pair.partition("=")
            if not equals or name.strip() not in PhysicsValues.model_fields:
                allowed = ", ".join(PhysicsValues.model_fields)
                raise CommandError(
                    f"--physics {text}: {pair.strip()!r} is not a NAME=VALUE with a name out of "
                    f"{allowed}"
                )
            own[name.strip()] = value.strip()
    values = {}
    for subject, own in fields.items():
        try:
            values[subject] = PhysicsValues.model_validate(own, strict=False)
        except ValidationError as problem:
            first = problem.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise CommandError(
                f"--physics {where or 'values'}: {invalid_reason(first)}"
            ) from problem
    return values


def changed(setup: Experiment, values: dict[str, PhysicsValues]) -> dict[str, ObjectPhysics]:
    """Objects of a setup, with the values for all objects and for each."""
    from ..simulation.structure import with_values

    objects = setup.options.objects
    unknown = sorted(values.keys() - objects.keys() - {"*"})
    if unknown:
        raise CommandError(
            f"--physics is given for {unknown[0]!r}, which is not simulated; simulated objects: "
            f"{', '.join(objects)}"
        )
    return {
        name: with_values(own, values.get("*"), values.get(name)) for name, own in objects.items()
    }


def continue_driving(
    scene: Scene, state: PlacedObjects, objects: tuple[str, ...], frame: int, *, preset: str
) -> Experiment:
    """An experiment in which the named objects continue their recorded motion."""
    import numpy as np

    from ..simulation.experiments import Experiment, scene_road
    from ..simulation.rollout import SimulateOptions
    from ..simulation.structure import ObjectPhysics

    if not objects:
        raise CommandError("choose objects with --object, or an --experiment")
    if frame >= len(scene.frame_times_us):
        last = len(scene.frame_times_us) - 1
        raise CommandError(f"--frame {frame}; the scene has frames 0 to {last}")
    start_us = int(scene.frame_times_us[frame])
    options = SimulateOptions(
        preset=preset,
        objects={name: ObjectPhysics() for name in objects},
        colliders=[scene_road(scene, state, start_us)],
        start_us=start_us,
    )
    first = {o.object_id: o for o in state.visible}.get(objects[0])
    focus = np.zeros(3) if first is None else first.trajectory.transform(start_us)[:3, 3]
    return Experiment("rollout", options, objects, focus, np.array([-1.0, 1.0, 0.6]), 10.0)


def _figures(result: SimulationResult) -> dict[str, object]:
    import numpy as np

    figures: dict[str, object] = {k: v for k, v in result.figures.items() if k != "gravity"}
    if "background" in figures:
        figures["colliders of the background"] = len(result.figures["background"])
        del figures["background"]
    figures["simulated [s]"] = float(result.times_s[-1])
    for name, o in result.objects.items():
        figures[f"{name} mass [kg]"] = o.mass
        figures[f"{name} speed at the end [m/s]"] = float(np.linalg.norm(o.velocities[-1]))
        if len(o.shapes):
            moved = np.linalg.norm(o.shapes.astype(np.float64), axis=2)
            figures[f"{name} deepest dent [m]"] = float(moved.max())
            figures[f"{name} dent left [m]"] = float(moved[-1].max())
    for c in result.contacts:
        figures[f"{c.object_id} by {c.other}: first contact [s]"] = c.first_s
        figures[f"{c.object_id} by {c.other}: delta-v [m/s]"] = c.delta_v
        figures[f"{c.object_id} by {c.other}: of it beyond its weight [m/s]"] = c.impact_delta_v
    return figures


# --- calibrate ------------------------------------------------------------------------------------


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
            help="JSON file of boxes, points and images, as in the REST job. Image paths are "
            "relative to it. Default: the object's own recorded track.",
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
        int, typer.Option(min=100, max=4_000_000, help="Maximum particles of all bodies.")
    ] = 20_000,
    steps: Annotated[int, typer.Option(min=1, max=60, help="Maximum steps of the search.")] = 12,
    json: JsonFile = None,
) -> None:
    """Fit an object's physical parameters to observations.

    Reports the uncertainty of each parameter, from the observations and from the cell size.
    """
    from ..edit.state import ScenarioState
    from ..scene.io import open_scene
    from ..simulation.calibration import calibrate_object, observations_of

    given = _read(observed)
    loaded = open_scene(scene)
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
    print_figures(f"{subject} of {scene.name}", _calibrated_values(found))
    write_json(json, found.figures())


def _read(path: Path | None) -> Observations:
    """Read observations from a file, including the image files that it names."""
    import base64
    import json

    from pydantic import ValidationError

    from real2sim_proto.base import invalid_reason
    from real2sim_proto.jobs import Observations

    if path is None:
        return Observations(recorded=True)
    try:
        document = json.loads(read_text(path))
        for image in document.get("images", []):
            if "file" in image:
                data = (path.parent / image.pop("file")).read_bytes()
                image["image"] = base64.b64encode(data).decode("ascii")
        return Observations.model_validate(document)
    except ValidationError as problem:
        first = problem.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise CommandError(f"{path}: {where}: {invalid_reason(first)}") from problem
    except (OSError, ValueError, AttributeError, TypeError) as problem:
        raise CommandError(f"{path}: no readable observations: {problem}") from problem


def _calibrated_values(found: ObjectCalibration) -> dict[str, object]:
    fit = found.fit
    figures: dict[str, object] = {}
    for name, factor in fit.factors.items():
        if name in fit.undetermined:
            figures[name] = "not determined by these observations"
            continue
        value = f", {found.values[name]:.4g}" if name in found.values else ""
        figures[name] = f"times {factor:.3f} +- {100 * fit.uncertainty[name]:.1f} %{value}"
    figures["differences over uncertainty"] = f"{fit.residual[0]:.3g} to {fit.residual[-1]:.3g}"
    figures["simulations"] = fit.runs
    return figures


# --- validate -------------------------------------------------------------------------------------


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
    """Run the requested cases.

    ``published`` selects all published crash figures, ``simulation`` all cases of tyres, mode
    changes and thin obstacles.
    """
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
