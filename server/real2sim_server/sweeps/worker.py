"""Drives episodes of one scene, for whichever executor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from real2sim.planners import load_planner

from ..executors import Recipe
from ..world import warm_up
from .episode import Drive, Driven, drive_episode
from .scenes import open_scene

Row = dict[str, Any]
"""Columns of one episode: numbers, text, truth values, None for what is not known."""

COLUMNS: Mapping[str, type] = {
    "reason": str,
    "error": str,
    "steps": int,
    "seconds": float,
    "distance": float,
    "collisions": int,
    "at_fault": int,
    "off_road": bool,
    "criticality": float,
    "min_gap": float,
    "min_margin": float,
    "min_ttc": float,
    "impact_speed": float,
    "impact_side": str,
    "impact_object": str,
    "impact_kind": str,
}
"""What is measured of every episode; wall-clock times are not, so that tables can be compared."""


def recipe_of(scene: str, scenes: Path | None, metrics: Sequence[str] = ()) -> Recipe:
    """Makes workers for a scene; see :func:`~.scenes.open_scene`."""
    return partial(EpisodeWorker, scene, scenes, tuple(metrics))


class EpisodeWorker:
    """Holds a scene.

    Args:
        scene, scenes: as :func:`~.scenes.open_scene` takes them.
        metrics: scores that get columns.
        threads: that it computes with.
    """

    def __init__(
        self, scene: str, scenes: Path | None, metrics: Sequence[str], threads: int
    ) -> None:
        import numba
        import torch

        numba.set_num_threads(min(threads, numba.get_num_threads()))
        torch.set_num_threads(threads)
        warm_up()
        self._scene = open_scene(scene, scenes)
        self._metrics = metrics

    def make(self, task: Drive) -> Row:
        """The row of an episode."""
        driven = drive_episode(self._scene, task, load_planner(task.planner))
        return row_of(driven, self._metrics)


def row_of(driven: Driven, metrics: Sequence[str] = ()) -> Row:
    """Columns of an episode that was driven, and the scores that are asked for."""
    row: Row = dict.fromkeys(COLUMNS)
    row |= {f"score_{name}": None for name in metrics}
    row["error"] = driven.error
    if (world := driven.world) is None:
        return row | {"reason": "refused"}
    last = world.accumulator
    scores = {s.name: s.value for s in world.scores()} if metrics else {}
    return row | {
        "reason": "planner failed" if driven.error else world.reason or "over",
        "steps": world.steps,
        "seconds": world.steps * world.context.dt,
        "distance": last.distance,
        "collisions": last.collisions,
        "at_fault": sum(last.at_fault.values()),
        "off_road": last.off_road,
        "criticality": driven.criticality,
        "min_gap": _finite(driven.danger.gap),
        "min_margin": driven.danger.margin,
        "min_ttc": _finite(last.min_ttc),
        **_impact(driven),
        **{f"score_{name}": scores.get(name) for name in metrics},
    }


def _impact(driven: Driven) -> Row:
    """Of the first contact, where the episode ended with it."""
    assert driven.world is not None
    begun = [c for c in driven.world.instant.contacts if c.begun]
    if not begun:
        return {"impact_speed": driven.world.accumulator.first_impact}
    first = min(begun, key=lambda c: (c.since, c.object_id or ""))
    return {
        "impact_speed": first.relative_speed,
        "impact_side": first.side,
        "impact_object": first.object_id,
        "impact_kind": first.category,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
