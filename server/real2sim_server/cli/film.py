"""``real2sim film``: film what ``real2sim simulate`` has left, again or otherwise."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..console import CommandError, console, staged_progress
from .command import command
from .options import RenderBackend, RenderDevice, SceneBundle, chosen_backend


@command("film")
def film(
    *,
    scene: SceneBundle,
    run: Annotated[Path, typer.Argument(help="Output folder of `real2sim simulate`.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder; default: the same.")
    ] = None,
    view: Annotated[str, typer.Option(help="Camera: near, scene or both.")] = "both",
    width: Annotated[
        int | None, typer.Option(min=64, max=4096, help="Width of each view [px].")
    ] = None,
    slow: Annotated[
        float | None, typer.Option(min=0.1, max=100, help="Slow-motion factor.")
    ] = None,
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
) -> None:
    """Render film.mp4 and strip.png of a finished simulation again."""
    from ..edit.state import ScenarioState
    from ..scene.io import load_scene
    from ..simulation.ego import EGO, with_ego
    from ..simulation.experiments import FilmPlan, views, write_film
    from ..simulation.playback import PlacedObjects, Playback
    from ..simulation.result import SimulationResult

    names = {"near": ["near"], "scene": ["scene"], "both": ["scene", "near"]}
    if view not in names:
        raise CommandError(f"--view {view!r}; allowed are {', '.join(names)}")
    backend = chosen_backend(backend, device)
    plan, result = FilmPlan.load(run), SimulationResult.load(run / "simulation")
    loaded = load_scene(scene)
    state: PlacedObjects = ScenarioState.of(loaded)
    if EGO in result.objects:
        loaded, state = with_ego(loaded, state)
    playback = Playback(loaded, state, result)
    folder = run if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    with staged_progress() as report:
        write_film(
            playback,
            [v for v in views(playback, plan, width=width) if v.camera.name in names[view]],
            folder,
            slow=plan.slow if slow is None else slow,
            backend=backend,
            on_progress=lambda done, total: report("film", done, total),
        )
    console.print(f"in {folder}: film.mp4, strip.png", highlight=False)
