"""``real2sim bench planners``: time per plan of the SDK's rule planners, and per world step."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from real2sim.observation import observation_from_wire
from real2sim.planners import load_planner, needs_of
from real2sim_proto.drive import Obs
from real2sim_proto.episode import ResetSpec
from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState
from real2sim_server.scene import Scene
from real2sim_server.scene.io import read_packed
from real2sim_server.world import World, warm_up

from .serve import percentiles

Figures = dict[str, Any]

PLANNERS = ("follow_route", "idm", "pid")
EPISODES = 3
PARTS = ("observe", "plan", "step")


def run() -> Figures:
    """Milliseconds of observing, planning and stepping by planner, and plans per world step."""
    warm_up()
    scene = read_packed(SHIPPED)
    figures: Figures = {name: _planner(scene, name) for name in PLANNERS}
    _print(Console(), figures)
    return figures


def _planner(scene: Scene, name: str) -> Figures:
    rows = [times for _ in range(EPISODES) for times in _episode(scene, name)]
    spent = np.array(rows) * 1e3
    parts = {part: percentiles(spent[:, k].tolist()) for k, part in enumerate(PARTS)}
    ratio = parts["plan"]["p50"] / parts["step"]["p50"]
    return {"steps": len(rows), **parts, "plan_over_step": ratio}


def _episode(scene: Scene, name: str) -> list[tuple[float, float, float]]:
    """Times of the parts of each step [s]."""
    planner = load_planner(name)
    spec = ResetSpec(privileged=True, action=needs_of(planner).action)
    world = World(scene, ScenarioState.of(scene), spec)
    rows: list[tuple[float, float, float]] = []
    while not world.over:
        begun = time.perf_counter()
        obs = observation_from_wire(Obs(**world.observe().obs_fields(), frames=[]))
        seen = time.perf_counter()
        if not rows:
            planner.reset(obs)
            seen = time.perf_counter()
        plan: Any = planner.plan(obs)
        planned = time.perf_counter()
        world.step(plan)
        rows.append((seen - begun, planned - seen, time.perf_counter() - planned))
    return rows


def _print(console: Console, figures: Figures) -> None:
    title = "a step of an episode without images, ms, p50"
    table = Table("", *PARTS, "plan p95", "plan : step", title=title, title_justify="left")
    for name, case in figures.items():
        table.add_row(
            name,
            *(f"{case[part]['p50']:.2f}" for part in PARTS),
            f"{case['plan']['p95']:.2f}",
            f"{case['plan_over_step']:.1f}",
        )
    console.print(table)
