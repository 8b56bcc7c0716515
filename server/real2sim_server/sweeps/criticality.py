"""How near an episode came to a collision that would have been its driver's fault."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..world import World
from ..world.scoring.contact_side import STOPPED
from .gap_kernels import least_margin
from .gaps import signed_gaps

PER_METRE = 2.0
"""What a metre between both counts [s/m]: to pass somebody half a metre aside is as near as to meet
them in a second."""
SHARPNESS = 16.0
"""Of the smooth minimum over time [1/s]."""
FARTHEST = 10.0
"""Margins are cut here [s]."""
AT_FAULT, PER_SPEED = 0.5, 0.05
"""What an at-fault collision adds, and each m/s of its speed."""


@dataclass
class Danger:
    """Followed over an episode, instant by instant.

    The margin of an instant is how soon the front bumper would meet another if all kept their
    velocities, with what is missing to a touch counted as time: what comes from behind or stands
    beside says nothing about the driver. The episode's is a smooth minimum over time;
    :meth:`criticality` is its negative, in seconds, and above 0 only for collisions at fault.

    Attributes:
        gap: smallest from the ego's box to another's so far, below 0 where they overlap [m].
        margin: smallest so far [s].
    """

    gap: float = math.inf
    margin: float = FARTHEST
    _sum: float = 0.0

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
        bumper = (x + length / 2 * cos, y + length / 2 * sin, ego.yaw, 0.0, width)
        velocity = (
            ego.speed * cos - ego.lateral_speed * sin,
            ego.speed * sin + ego.lateral_speed * cos,
        )
        found = least_margin(bumper, velocity, (*where, others.velocities), PER_METRE)
        margin = min(float(found), FARTHEST)
        self.margin = min(self.margin, margin)
        self._sum += math.exp(-SHARPNESS * margin)

    def criticality(self, world: World) -> float:
        """Of the episode up to now: -10 far from everybody, around 0 at a touch, more with fault
        and speed."""
        smooth = -math.log(self._sum + math.exp(-SHARPNESS * FARTHEST)) / SHARPNESS
        found = -min(smooth, FARTHEST)
        if sum(world.accumulator.at_fault.values()):
            found += AT_FAULT + PER_SPEED * (world.accumulator.first_impact or 0.0)
        else:
            # Without fault it cannot be a failure, however near.
            found = min(found, 0.0)
        return found
