"""What a point of a space is worth to a search: how critical it is where it could be avoided."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim.planners import Needs, load_planner

from ...scene import Scene
from ...world import World
from ..criticality import adversaries_of
from ..episode import OPERATIONS, Drive, Driven, begin, drive_episode
from ..parameters import Value, drawn_parameters, values_at
from ..spec import Space
from .realism import Manners, Watch
from .reference import Drove, drive_reference

UNAVOIDABLE, REFUSED = -1.0, -200.0
"""Scores of a failure that the reference does not avoid, and of what cannot begin."""
MOST_STRANGE = 0.5
"""A collision in a case that is less plausible than this is no finding."""
SPEED_BIN = 2.0
"""Width of the archive's cells [m/s]."""

Cell = tuple[str, str, str]
"""Where on the ego, speed of the impact, kind of the other."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A point that was driven.

    Attributes:
        space: number of its space.
        point: coordinates from 0 to 1.
        values: of the parameters.
        drive: the episode.
        score: higher is nearer to an avoidable failure; above 0 for one.
        criticality: of the tested planner.
        implausibility: subtracted from it.
        at_fault: whether the planner caused a collision.
        avoided: whether the reference survived the same; None where it was not asked.
        cell: of the archive; None unless at fault.
        impact: columns of the collision.
    """

    space: int
    point: tuple[float, ...]
    values: Mapping[str, Value]
    drive: Drive
    score: float
    criticality: float
    implausibility: float
    at_fault: bool
    avoided: bool | None
    cell: Cell | None
    impact: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_failure(self) -> bool:
        """Whether the planner was at fault for what could be avoided, in a plausible case."""
        return self.at_fault and bool(self.avoided) and self.implausibility <= MOST_STRANGE


class Evaluator:
    """Drives points of spaces of one scene with one planner.

    Args:
        scene: of all spaces.
        spaces: that are searched.
        planner: tested, by name.
        seed: of the episodes.
    """

    def __init__(
        self, scene: Scene, spaces: Sequence[Space], planner: str, *, seed: int = 0
    ) -> None:
        self.scene, self.spaces, self.planner, self.seed = scene, list(spaces), planner, seed
        self.manners = Manners.of(scene)
        self.done = 0

    def dimensions(self, space: int) -> int:
        """Coordinates of a point of a space."""
        return len(drawn_parameters(self.spaces[space].parameters))

    def __call__(self, space: int, point: Sequence[float] | NDArray[np.float64]) -> Evaluation:
        """Drive a point; one more evaluation is counted."""
        self.done += 1
        asked = self.spaces[space]
        inside = tuple(float(min(max(u, 0.0), 1.0)) for u in point)
        values = values_at(asked.parameters, inside)
        case = asked.case_at(values)
        drive = Drive.of(case, self.planner, self.seed)
        watch = Watch(adversaries_of(drive.reset), self.manners)
        driven = drive_episode(self.scene, drive, load_planner(self.planner), on_world=watch.add)
        given: dict[str, Any] = {"space": space, "point": inside, "values": values, "drive": drive}
        if driven.world is None or driven.error is not None:
            return Evaluation(**given, **_nothing())
        strange = watch.implausibility()
        score, avoided = driven.criticality - strange, None
        if driven.at_fault:
            avoided = self.reference(drive).survived
            # A finding is above 0; what nobody avoids, or nobody does, is not sought.
            if not avoided:
                score = UNAVOIDABLE - strange
            elif strange > MOST_STRANGE:
                score = -strange
            else:
                score = max(score, 0.01)
        return Evaluation(
            **given,
            score=score,
            criticality=driven.criticality,
            implausibility=strange,
            at_fault=driven.at_fault,
            avoided=avoided,
            cell=cell_of(driven) if driven.at_fault else None,
            impact=impact_of(driven) if driven.at_fault else {},
        )

    def reference(self, drive: Drive) -> Drove:
        """The same episode with the reference at the wheel."""
        world = begin(self.scene, drive, Needs(), privileged=False)
        if drive.operations:
            world.apply(OPERATIONS.validate_python([dict(o) for o in drive.operations]))
        return drive_reference(world)


def cell_of(driven: Driven) -> Cell:
    """Of an at-fault collision."""
    impact = impact_of(driven)
    low = SPEED_BIN * math.floor((impact["speed"] or 0.0) / SPEED_BIN)
    return impact["where"], f"{low:g} to {low + SPEED_BIN:g} m/s", impact["kind"]


def impact_of(driven: Driven) -> dict[str, Any]:
    """What an at-fault collision was: where on the ego, with whom, how fast."""
    assert driven.world is not None
    world = driven.world
    begun = [c for c in world.instant.contacts if c.begun]
    first = min(begun, key=lambda c: (c.since, c.object_id or "")) if begun else None
    speed = first.relative_speed if first else world.accumulator.first_impact
    drivers = world.spec.agents.drivers
    name = first.object_id if first else None
    kind = first.category if first else "unknown"
    if name is not None and name in drivers:
        kind = f"{kind}, {drivers[name].kind}"
    return {
        "time": world.steps * world.context.dt,
        "speed": speed,
        "side": first.side if first else None,
        "where": _where(world, name, first.side if first else "front"),
        "object": name,
        "kind": kind,
    }


def _where(world: World, name: str | None, side: str) -> str:
    """Third of the front, or side of the ego, on which another touches it."""
    others, ego, context = world.instant.others, world.instant.ego, world.context
    if name is None or name not in others.ids:
        return side
    k = others.ids.index(name)
    turned = float(others.yaws[k]) - ego.yaw
    dx, dy = (others.centres[k, :2] - np.array([ego.x, ego.y])).tolist()
    y = math.cos(ego.yaw) * dy - math.sin(ego.yaw) * dx
    length, width = others.sizes[k, :2].tolist()
    reach = (abs(math.sin(turned)) * length + abs(math.cos(turned)) * width) / 2
    half = context.ego_size[1] / 2
    if side not in {"front", "stopped_track"}:
        return "left" if y > 0 else "right"
    middle = (max(y - reach, -half) + min(y + reach, half)) / 2
    if abs(middle) <= half / 3:
        return "front"
    return "front left" if middle > 0 else "front right"


def _nothing() -> dict[str, Any]:
    return {
        "score": REFUSED,
        "criticality": REFUSED,
        "implausibility": 0.0,
        "at_fault": False,
        "avoided": None,
        "cell": None,
    }
