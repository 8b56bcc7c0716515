"""``real2sim doctor``: what this machine can do, what is missing, how to mend it."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import time
from typing import Annotated

import typer
from rich.table import Table

from ..console import SERVER_MODULES, console, write_json
from .command import app
from .options import JsonFile

DISTRIBUTIONS = (
    "real2sim",
    "torch",
    "numba",
    "numpy",
    "fastapi",
    "uvicorn",
    "gsplat",
    "numba-cuda",
)


@app.command("doctor")
def doctor(
    *,
    warm: Annotated[
        bool, typer.Option("--warm", help="Compile all kernels of a worker into the cache.")
    ] = False,
    warmed: Annotated[
        bool, typer.Option("--warmed", help="Fail if a worker had kernels to compile.")
    ] = False,
    json: JsonFile = None,
) -> None:
    """Say what this machine can do, what is missing, and how to mend it."""
    findings = {"python": platform.python_version(), "cores": str(os.cpu_count())}
    findings |= {name: _version(name) for name in DISTRIBUTIONS}
    missing = [name for name in SERVER_MODULES if importlib.util.find_spec(name) is None]
    advice = [f"pip install 'real2sim[server]'  # for {', '.join(missing)}"] if missing else []
    backends: list[dict[str, object]] = []
    if not missing:
        backends, more = _inspect_backends()
        advice += more
    compiled: list[str] = []
    if (warm or warmed) and not missing:
        seconds, compiled = _warm_up()
        findings["kernels ready in"] = f"{seconds:.1f} s, {len(compiled)} compiled"
    if warmed and compiled:
        advice.append(f"real2sim doctor --warm  # compiles {', '.join(sorted(compiled)[:8])}")
    _print(findings, backends, advice)
    write_json(json, {"findings": findings, "backends": backends, "advice": advice})
    if missing or (warmed and compiled):
        raise typer.Exit(1)


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _inspect_backends() -> tuple[list[dict[str, object]], list[str]]:
    from ..render import describe_backends

    described = describe_backends()
    rows: list[dict[str, object]] = [
        {"name": b.name, "usable": b.usable, "reason": b.reason} for b in described
    ]
    return rows, [f"{b.name}: {b.remedy}" for b in described if b.remedy]


def _warm_up() -> tuple[float, list[str]]:
    """Seconds until the kernels of a worker are ready, and names of those that were compiled."""
    from numba.core import event

    from .. import render, world

    start = time.perf_counter()
    with event.install_recorder("numba:compile") as recorder:
        render.warm_up()
        world.warm_up()
        world.warm_up_planning()
    began = (found for _, found in recorder.buffer if found.is_start)
    names = {found.data["dispatcher"].__name__ for found in began}
    return time.perf_counter() - start, sorted(names)


def _print(findings: dict[str, str], backends: list[dict[str, object]], advice: list[str]) -> None:
    table = Table(title="this machine", title_justify="left", show_header=False)
    for name, value in findings.items():
        table.add_row(name, value)
    console.print(table)
    if backends:
        table = Table("backend", "usable", "reason", title="rendering", title_justify="left")
        for row in backends:
            table.add_row(str(row["name"]), "yes" if row["usable"] else "no", str(row["reason"]))
        console.print(table)
    for line in advice:
        console.print(f"to mend: {line}", highlight=False)
