"""``real2sim bench``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import JsonFile, bench, run_command


@bench.command("render")
def bench_render(
    splat: Annotated[Path | None, typer.Option(help="Splat file for the first case.")] = None,
    json: JsonFile = None,
) -> None:
    """Milliseconds by stage and Gaussians per second, as ratio to the plain reference."""
    from . import bench_render as command

    run_command(command.run, splat=splat, json_path=json)


@bench.command("reconstruct")
def bench_reconstruct(json: JsonFile = None) -> None:
    """Training iterations per second by stage, at 76,000 Gaussians and 621x188."""
    from . import bench_reconstruct as command

    run_command(command.run, json_path=json)


@bench.command("physics")
def bench_physics(
    peers: Annotated[
        bool, typer.Option("--peers", help="Also measure Taichi and Warp, where installed.")
    ] = False,
    json: JsonFile = None,
) -> None:
    """Particle-substeps per second, and what they depend on."""
    from . import bench_physics as command

    run_command(command.run, peers=peers, json_path=json)


@bench.command("serve")
def bench_serve(json: JsonFile = None) -> None:
    """Latency of a drive step, share of rendering, lag of the event loop, memory per session."""
    from . import bench_serve as command

    run_command(command.run, json_path=json)


@bench.command("world")
def bench_world(json: JsonFile = None) -> None:
    """Time of a step of the world alone: vehicle, traffic, contact, scores; also uncompiled."""
    from . import bench_world as command

    run_command(command.run, json_path=json)


@bench.command("soak")
def bench_soak(
    sessions: Annotated[int, typer.Option(min=1, max=32)] = 16,
    minutes: Annotated[float, typer.Option(min=0.1, max=1440)] = 10.0,
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="Steps/s of a session.")] = 10.0,
    json: JsonFile = None,
) -> None:
    """Many sessions side by side, misbehaving planners among them; every answer, and memory."""
    from . import bench_soak as command

    run_command(command.run, sessions=sessions, minutes=minutes, rate=rate, json_path=json)


@bench.command("edit")
def bench_edit(
    operations: Annotated[int, typer.Option(min=1, max=100_000)] = 1000, json: JsonFile = None
) -> None:
    """Time of an edit, and of opening a scenario that has had many."""
    from . import bench_edit as command

    run_command(command.run, operations=operations, json_path=json)
