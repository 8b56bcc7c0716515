"""``real2sim bench world``: time of a world step without images, sockets or log, compiled and
uncompiled.

Uncompiled steps run in a subprocess, with this module as the program.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import TrajectoryPlan
from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState
from real2sim_server.scene import Scene
from real2sim_server.scene.io import read_packed
from real2sim_server.world import World, warm_up

from .drive_probe import straight_on
from .serve import percentiles

Figures = dict[str, Any]

DYNAMIC = {"dynamics": "dynamic_bicycle"}
CASES: Mapping[str, Mapping[str, Any]] = {
    "pursuit": {},
    "lqr": {"ego": {"tracker": "lqr"}},
    "ilqr": {"ego": {"tracker": "ilqr"}},
    "dynamic, pursuit": {"ego": DYNAMIC},
    "dynamic, ilqr": {"ego": {**DYNAMIC, "tracker": "ilqr"}},
    "idm traffic": {"agents": {"default": "idm"}},
    "contact": {"on_collision": "continue"},
    "contact, idm": {"on_collision": "continue", "agents": {"default": "idm"}},
}
"""Reset specs by case; the default is a kinematic car among 18 objects that replay the log."""

HALVES = ("move", "evaluate", "observe")
EPISODES, EPISODES_UNCOMPILED = 5, 1


def run() -> Figures:
    """Microseconds per step by case, and the ratio of uncompiled to compiled steps."""
    console = Console()
    with console.status("compiled"):
        compiled = measured(EPISODES)
    with console.status("not compiled"):
        plain = _uncompiled()
    figures: Figures = {
        name: {**case, "uncompiled_over_compiled": plain[name]["step"]["p50"] / case["step"]["p50"]}
        for name, case in compiled.items()
    }
    _print(console, figures)
    return figures


def measured(episodes: int) -> Figures:
    """Microseconds of both halves of a step and of the whole step, by case."""
    warm_up()
    scene = read_packed(SHIPPED)
    return {name: _case(scene, spec, episodes) for name, spec in CASES.items()}


def _case(scene: Scene, spec: Mapping[str, Any], episodes: int) -> Figures:
    steps = [times for _ in range(episodes) for times in _episode(scene, ResetSpec(**spec))]
    spent = np.array(steps) * 1e6
    columns = dict(zip((*HALVES, "step"), (*spent.T, spent.sum(axis=1)), strict=True))
    return {"steps": len(steps), **{n: percentiles(c.tolist()) for n, c in columns.items()}}


def _episode(scene: Scene, spec: ResetSpec) -> Iterator[tuple[float, float, float]]:
    """Times of both halves of each step, as run by a session [s]."""
    world = World(scene, ScenarioState.of(scene), spec)
    while not world.over:
        plan = TrajectoryPlan.model_validate(straight_on(world.t_us))
        world = world.fork()
        begun = time.perf_counter()
        world.move(plan)
        moved = time.perf_counter()
        world.evaluate()
        evaluated = time.perf_counter()
        world.observe()
        yield moved - begun, evaluated - moved, time.perf_counter() - evaluated


def _uncompiled() -> Figures:
    answer = subprocess.run(
        [sys.executable, "-m", __name__],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        stdout=subprocess.PIPE,
        check=True,
    )
    found: Figures = json.loads(answer.stdout)
    return found


def _print(console: Console, figures: Figures) -> None:
    titles = (*HALVES, "step", "p95", "steps/s", "uncompiled")
    title = "a step of the world, us, p50"
    table = Table("", *titles, title=title, title_justify="left")
    for name, case in figures.items():
        step = case["step"]
        table.add_row(
            name,
            *(f"{case[half]['p50']:.0f}" for half in (*HALVES, "step")),
            f"{step['p95']:.0f}",
            f"{1e6 / step['p50']:,.0f}",
            f"x {case['uncompiled_over_compiled']:.1f}",
        )
    console.print(table)


if __name__ == "__main__":
    print(json.dumps(measured(EPISODES_UNCOMPILED)))
