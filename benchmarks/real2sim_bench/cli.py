"""``real2sim bench``: commands that measure the performance of this machine."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from real2sim_server.cli.common import JsonFile, command
from real2sim_server.console import CommandError, print_figures, progress, write_json

app = typer.Typer(
    name="bench", no_args_is_help=True, help="Measure this machine, as ratios to a reference."
)


LIBRARIES = ("real2sim", "numpy", "torch", "numba", "llvmlite")
"""Libraries that determine performance."""


class SoakFailedError(RuntimeError):
    """Error: the worker violated the protocol, or its memory grew."""


@command("render", group=app)
def render(
    *,
    splat: Annotated[Path | None, typer.Option(help="Splat file for the first case.")] = None,
    json: JsonFile = None,
) -> None:
    """Measure rendering: time per stage and Gaussians per second."""
    from . import render

    _report(json, render.run(splat=splat))


@command("sensors", group=app)
def sensors(*, json: JsonFile = None) -> None:
    """Measure LiDAR sweeps, and lenses and shutters against a pinhole."""
    from . import sensors

    _report(json, sensors.run())


@command("reconstruct", group=app)
def reconstruct(*, json: JsonFile = None) -> None:
    """Measure training iterations per second, at 76,000 Gaussians and 621x188."""
    from . import reconstruct

    figures = reconstruct.run()
    stages = {f"{name} [ms]": ms for name, ms in figures["stage_ms"].items()}
    others = {name: value for name, value in figures.items() if name != "stage_ms"}
    print_figures("training", others | stages)
    _report(json, figures)


@command("physics", group=app)
def physics(
    *,
    peers: Annotated[
        bool, typer.Option("--peers", help="Also measure Taichi and Warp, if installed.")
    ] = False,
    backend: Annotated[Literal["cpu", "cuda"], typer.Option(help="Backend of the solver.")] = "cpu",
    json: JsonFile = None,
) -> None:
    """Measure the physics solver in particle substeps per second."""
    from real2sim_server.physics.backends import select_backend

    from . import physics

    if backend == "cuda":
        if peers:
            raise CommandError("--peers needs --backend cpu")
        select_backend("cuda")  # Raises with the missing requirements.
    with progress("measuring") as report:
        figures = physics.run(peers=peers, backend=backend, on_progress=report)
    print_figures("particle-substeps per second", physics.as_rows(figures))
    _report(json, figures)


@command("serve", group=app)
def serve(*, json: JsonFile = None) -> None:
    """Measure latency of a drive step, event loop lag and memory per session."""
    from . import serve

    _report(json, serve.run())


@command("world", group=app)
def world(*, json: JsonFile = None) -> None:
    """Measure a step of the world alone: vehicle, traffic, contact, scores."""
    from . import world

    _report(json, world.run())


@command("planners", group=app)
def planners(*, json: JsonFile = None) -> None:
    """Measure the SDK's rule planners against a step of the world."""
    from . import planners

    _report(json, planners.run())


@command("search", group=app)
def search(
    *,
    episodes: Annotated[int, typer.Option(min=20, help="Maximum episodes per search.")] = 300,
    seeds: Annotated[int, typer.Option(min=0, help="Searches per planner.")] = 5,
    first_seed: Annotated[int, typer.Option(min=0, help="First seed of the searches.")] = 0,
    planner: Annotated[
        list[str] | None,
        typer.Option(help="idm, follow_route, pid or learned; default: all."),
    ] = None,
    policy: Annotated[Path | None, typer.Option(help="Weights of the learned planner.")] = None,
    whole: Annotated[int, typer.Option(min=0, help="Searches per planner through all spaces.")] = 1,
    json: JsonFile = None,
) -> None:
    """Compare search with random sampling: episodes to the first avoidable failure."""
    from . import search
    from .search import CASES, SearchBenchOptions

    names = tuple(planner or CASES)
    if unknown := sorted(set(names) - set(CASES)):
        raise CommandError(f"no planner {unknown[0]!r} in this bench; known: {', '.join(CASES)}")
    if policy is None and "learned" in (planner or ()):
        raise CommandError("the learned planner takes --policy, weights as of train-policy")
    asked = SearchBenchOptions(
        episodes=episodes,
        seeds=seeds,
        first_seed=first_seed,
        policy=policy,
        whole=whole,
        planners=names,
    )
    _report(json, search.run(asked))


@command("learn", group=app)
def learn(*, json: JsonFile = None) -> None:
    """Measure steps and small images per second for learning."""
    from . import learn

    _report(json, learn.run())


@command("soak", group=app)
def soak(
    *,
    sessions: Annotated[int, typer.Option(min=1, max=32, help="Number of sessions.")] = 16,
    minutes: Annotated[float, typer.Option(min=0.1, max=1440, help="Duration [min].")] = 10.0,
    rate: Annotated[
        float, typer.Option(min=0.1, max=1000, help="Steps per second and session.")
    ] = 10.0,
    json: JsonFile = None,
) -> None:
    """Stress a worker with many sessions and misbehaving planners."""
    from . import soak

    figures = soak.run(soak.SoakOptions(sessions=sessions, minutes=minutes, rate_hz=rate))
    _report(json, figures)
    if figures["failures"]:
        raise SoakFailedError(f"{len(figures['failures'])} planners were let down; see above")
    if figures["grows"]:
        raise SoakFailedError("the worker's memory grew; see above")


@command("edit", group=app)
def edit(
    *,
    operations: Annotated[int, typer.Option(min=1, max=100_000, help="Number of edits.")] = 1000,
    json: JsonFile = None,
) -> None:
    """Measure an edit, and opening a scenario with many edits."""
    from . import edit

    _report(json, edit.run(edit.EditBenchOptions(operations=operations)))


@command("dataset", group=app)
def dataset(
    *,
    rounds: Annotated[
        int, typer.Option(min=1, max=100, help="Number of rounds; the minimum counts.")
    ] = 5,
    json: JsonFile = None,
) -> None:
    """Measure labelled frames: CPU time per part, frames per second."""
    from . import dataset

    figures = dataset.run(rounds=rounds)
    print_figures("a labelled frame", figures)
    _report(json, figures)


@command("recovery", group=app)
def recovery(
    *,
    scene: Annotated[
        Path | None, typer.Option(help="Scene bundle; default: the demo street.")
    ] = None,
    episodes: Annotated[int, typer.Option(min=8, max=1000, help="Episodes per planner.")] = 64,
    epochs: Annotated[int, typer.Option(min=1, max=10_000, help="Training epochs.")] = 300,
    seed: Annotated[int, typer.Option(min=0, max=1_000_000, help="Seed of the training.")] = 0,
    json: JsonFile = None,
) -> None:
    """Compare the learned planner with and without recovery data."""
    from . import recovery

    options = recovery.RecoveryBenchOptions(
        scene=scene, episodes=episodes, epochs=epochs, seed=seed
    )
    _report(json, recovery.run(options))


@command("detector", group=app)
def detector(
    *,
    scene: Annotated[
        Path | None,
        typer.Option(help="Bundle of a synthetic drive; default: the demo street."),
    ] = None,
    frames: Annotated[int, typer.Option(min=20, max=100_000, help="Training frames.")] = 2000,
    epochs: Annotated[int, typer.Option(min=1, max=1000, help="Training epochs.")] = 8,
    drives: Annotated[int, typer.Option(min=1, max=100, help="Test drives.")] = 4,
    seed: Annotated[int, typer.Option(min=0, max=1_000_000, help="Seed of the training.")] = 0,
    workers: Annotated[int, typer.Option(min=1, max=64, help="Export processes.")] = 1,
    json: JsonFile = None,
) -> None:
    """Compare a detector trained on exported labels with one trained on truth."""
    from . import detector

    options = detector.DetectorBenchOptions(
        scene=scene, frames=frames, epochs=epochs, drives=drives, seed=seed, workers=workers
    )
    _report(json, detector.run(options))


def _report(path: Path | None, figures: dict[str, Any]) -> None:
    """Print the environment of the figures; write both to ``path`` if it is given."""

    measured_with = environment()
    print_figures("measured with", measured_with)
    write_json(path, {**figures, "environment": measured_with})


def environment() -> dict[str, str | int]:
    """Versions of Python and of numerical libraries, operating system and CPU.

    Returns:
        ``python``, one entry for each of LIBRARIES ("not installed" if absent), ``system``, ``cpu``
        (model), and ``cpu_threads`` available to this process.
    """
    return {
        "python": platform.python_version(),
        **{library: _version(library) for library in LIBRARIES},
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": _cpu_model(),
        "cpu_threads": _cpu_threads(),
    }


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "not installed"


def _cpu_model() -> str:
    """Name of the processor from Linux, else from Python."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _cpu_threads() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1
