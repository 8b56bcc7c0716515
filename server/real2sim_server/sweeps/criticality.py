"""How near an episode came to a collision that would have been its driver's fault."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..world import World
from ..world.scoring.instant import STOPPED
from ..world.storyboard.run import object_ids_of
from .gap_kernels import least_margin
from .gaps import signed_gaps

PER_METRE = 2.0
"""What a metre between both counts [s/m]: to pass somebody half a metre aside is as near as to meet
them in a second."""
SHARPNESS = 16.0
"""Of the smooth minimum over time [1/s]."""
FARTHEST = 100.0
"""Margins are cut here [s]: half as many metres away, nobody is told from nobody."""
AT_FAULT, PER_SPEED = 0.5, 0.05
"""An at-fault collision, and each m/s of its speed."""
NOT_AT_FAULT = -1.0
"""At most, where others caused a collision: a margin of a second, so that no search ends there."""


def adversaries_of(
    reset: Mapping[str, Any], operations: Sequence[Mapping[str, Any]] = ()
) -> frozenset[str]:
    """Objects that a case is about: those with drivers, in a storyboard, or edited. Empty where it
    names none, which means everybody.

    Args:
        reset: options of an episode.
        operations: edits when it begins, as JSON.
    """
    names = set(reset.get("agents", {}).get("drivers", {}))
    names |= {str(o["object_id"]) for o in operations if o.get("object_id")}
    for entity in (reset.get("storyboard") or {}).get("entities", []):
        known = entity.get("object_id")
        names.update([known] if known else object_ids_of(entity["name"]))
    return frozenset(names)


@dataclass
class Danger:
    """Followed over an episode, instant by instant.

    The margin of an instant is how soon the front bumper would meet another if all kept their
    velocities, with what is missing to a touch counted as time: what comes from behind or stands
    beside says nothing about the driver. The episode's is a smooth minimum over time;
    :meth:`criticality` is its negative, in seconds, and above 0 only for collisions at fault.

    Attributes:
        adversaries: whose margins count, see :func:`adversaries_of`: parked cars that everybody
            passes would hide how near those come who make the case. Empty for all.
        gap: smallest from the ego's box to another's so far, below 0 where they overlap [m].
        margin: smallest so far [s].
    """

    adversaries: frozenset[str] = frozenset()
    gap: float = math.inf
    margin: float = FARTHEST
    _margins: list[float] = field(default_factory=list)

    def add(self, world: World) -> None:
        """The instant that a world is at."""
        instant, context = world.instant, world.context
        ego, others = instant.ego, instant.others
        if not others.ids:
            return
        cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
        x, y = ego.x + context.centre_ahead * cos, ego.y + context.centre_ahead * sin
        length, width, _ = context.ego_size
        where = others.centres, others.yaws, others.sizes
        self.gap = min(self.gap, float(signed_gaps((x, y, ego.yaw, length, width), *where).min()))
        if abs(ego.speed) <= STOPPED:
            return
        meant = [
            k
            for k, name in enumerate(others.ids)
            if name in self.adversaries or not self.adversaries
        ]
        if not meant:
            return
        bumper = (x + length / 2 * cos, y + length / 2 * sin, ego.yaw, 0.0, width)
        velocity = (
            ego.speed * cos - ego.lateral_speed * sin,
            ego.speed * sin + ego.lateral_speed * cos,
        )
        theirs = (*(values[meant] for values in where), others.velocities[meant])
        margin = min(float(least_margin(bumper, velocity, theirs, PER_METRE)), FARTHEST)
        self.margin = min(self.margin, margin)
        self._margins.append(margin)

    def criticality(self, world: World) -> float:
        """Of the episode up to now: -100 far from everybody, towards 0 the nearer; above 0 for a
        collision at fault, more with its speed."""
        if sum(world.accumulator.at_fault.values()):
            return AT_FAULT + PER_SPEED * (world.accumulator.first_impact or 0.0)
        margins = np.array(self._margins or [FARTHEST])
        least = float(margins.min())
        smooth = least - math.log(np.exp(-SHARPNESS * (margins - least)).sum()) / SHARPNESS
        # Without fault it cannot be a failure, however near.
        found = min(-smooth, 0.0)
        return min(found, NOT_AT_FAULT) if world.accumulator.collisions else found
