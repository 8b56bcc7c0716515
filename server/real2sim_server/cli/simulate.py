"""``real2sim simulate``: physics on the objects of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..console import CommandError, console, print_figures, staged_progress, write_json
from ..edit.state import ScenarioState
from ..scene import Scene
from ..scene.io import load_scene
from ..simulation.experiments import (
    Experiment,
    draw_curves,
    leave_film,
    scene_road,
    set_up,
    views,
    walls,
)
from ..simulation.playback import Playback
from ..simulation.presets import ObjectPhysics
from ..simulation.result import SimulationResult
from ..simulation.rollout import SimulateOptions, simulate


@dataclass(frozen=True)
class Asked:
    """The options as they were typed.

    Attributes:
        experiment: ``wall``, ``pair``, ``drop``, or None for the scene as it was driving.
        preset: ``paper`` or ``vehicle``; None takes what the experiment is known for.
        speed: of an experiment's vehicles [m/s].
        objects: ids that take part.
        duration: [s].
        frame: recorded frame to start at.
        backend: of solver and renderer.
        film: whether pictures are drawn.
        max_particles: of all bodies together; None takes the default.
    """

    experiment: str | None = None
    preset: str | None = None
    speed: float | None = None
    objects: tuple[str, ...] = ()
    duration: float | None = None
    frame: int = 0
    backend: str = "auto"
    film: bool = True
    max_particles: int | None = None


def run(*, scene: Path, out: Path, asked: Asked, json_path: Path | None) -> None:
    """Simulate on the bundle ``scene``; leave result, film, strip, curves in folder ``out``."""
    loaded = load_scene(scene)
    state = ScenarioState.of(loaded)
    experiment = _experiment(loaded, state, asked)
    out.mkdir(parents=True, exist_ok=True)
    with staged_progress() as tell:
        result = simulate(
            loaded,
            state,
            experiment.options,
            on_progress=lambda done, total: tell("simulate", done, total),
        )
        result.save(out / "simulation")
        draw_curves(result, out / "curves.png")
        if asked.film:
            playback = Playback(loaded, state, result)
            leave_film(
                playback,
                views(playback, experiment),
                out,
                outlines=walls(experiment),
                on_progress=lambda done, total: tell("film", done, total),
            )
    figures = _figures(result)
    print_figures(f"{experiment.name} on {scene.name}", figures)
    console.print(f"in {out}: film.mp4, strip.png, curves.png, simulation/", highlight=False)
    write_json(json_path, figures)


def _experiment(scene: Scene, state: ScenarioState, asked: Asked) -> Experiment:
    if asked.experiment is not None:
        made = set_up(
            asked.experiment,
            scene,
            state,
            preset=asked.preset or "paper",
            speed=asked.speed,
            objects=asked.objects,
        )
    else:
        made = _as_driven(scene, state, asked)
    options = replace(made.options, backend=asked.backend)
    if asked.duration is not None:
        options = replace(options, duration=asked.duration)
    if asked.max_particles is not None:
        options = replace(options, max_particles=asked.max_particles)
    return replace(made, options=options)


def _as_driven(scene: Scene, state: ScenarioState, asked: Asked) -> Experiment:
    """Everything named goes on from where and how fast it was driving."""
    if not asked.objects:
        raise CommandError("name what to simulate with --object, or take an --experiment")
    if asked.frame >= len(scene.frame_times_us):
        last = len(scene.frame_times_us) - 1
        raise CommandError(f"--frame {asked.frame}; the scene has frames 0 to {last}")
    start_us = int(scene.frame_times_us[asked.frame])
    options = SimulateOptions(
        preset=asked.preset or "vehicle",
        objects={name: ObjectPhysics() for name in asked.objects},
        colliders=[scene_road(scene, state, start_us)],
        start_us=start_us,
    )
    first = {o.object_id: o for o in state.visible}.get(asked.objects[0])
    focus = np.zeros(3) if first is None else first.trajectory.transform(start_us)[:3, 3]
    return Experiment("rollout", options, asked.objects, focus, np.array([-1.0, 1.0, 0.6]), 10.0)


def _figures(result: SimulationResult) -> dict[str, object]:
    figures: dict[str, object] = {k: v for k, v in result.figures.items() if k != "gravity"}
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
    return figures
