"""Criticality: how near an episode came to a collision at fault of its driver."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._numba import kernel
from ..world import World
from ..world.scoring.instant import STOPPED
from ..world.storyboard.run import object_ids_of

# --- Kernels -------------------------------------------------------------------------------------


@kernel
def signed_gaps_into(box, centres, yaws, sizes, found):
    """See :func:`.signed_gaps`; into ``found`` [K]."""
    x, y, yaw, length, width = box
    c, s = math.cos(yaw), math.sin(yaw)
    for k in range(len(yaws)):
        dx, dy = centres[k, 0] - x, centres[k, 1] - y
        turned = yaws[k] - yaw
        cos, sin = math.cos(turned), math.sin(turned)
        # The other's middle as the box sees it, and the box's as the other does.
        tx, ty = c * dx + s * dy, c * dy - s * dx
        ox, oy = -(cos * tx + sin * ty), -(cos * ty - sin * tx)
        la, wa, lb, wb = length / 2, width / 2, sizes[k, 0] / 2, sizes[k, 1] / 2
        ac, asin = abs(cos), abs(sin)
        ours = max(abs(tx) - la - lb * ac - wb * asin, abs(ty) - wa - lb * asin - wb * ac)
        theirs = max(abs(ox) - lb - la * ac - wa * asin, abs(oy) - wb - la * asin - wa * ac)
        separation = max(ours, theirs)
        if separation < 0.0:
            found[k] = separation
            continue
        nearest = math.inf
        for u, v in ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)):
            px, py = tx + cos * u * lb - sin * v * wb, ty + sin * u * lb + cos * v * wb
            nearest = min(nearest, _to_rectangle(px, py, la, wa))
            qx, qy = ox + cos * u * la + sin * v * wa, oy - sin * u * la + cos * v * wa
            nearest = min(nearest, _to_rectangle(qx, qy, lb, wb))
        found[k] = nearest


@kernel
def _to_rectangle(x, y, half_length, half_width):
    return math.hypot(max(abs(x) - half_length, 0.0), max(abs(y) - half_width, 0.0))


@kernel
def least_margin(bumper, velocity, others, per_metre):
    """The least of time and distance to others ahead: ``min over t of t + per_metre * gap(t)``.

    All keep their velocities, for 3 s in steps of 0.2 s.

    Args:
        bumper: centre x, y [m], yaw [rad], length, width [m] of the front of the ego.
        velocity: of it, x and y [m/s].
        others: centres [K, 3] [m], yaws [K] [rad], sizes [K, 3] [m], velocities [K, 2] [m/s].
        per_metre: [s/m].
    """
    x, y, yaw, length, width = bumper
    centres, yaws, sizes, velocities = others
    least = math.inf
    place, heading, size = np.empty((1, 2)), np.empty(1), np.empty((1, 2))
    gap = np.empty(1)
    for k in range(len(yaws)):
        dx, dy = centres[k, 0] - x, centres[k, 1] - y
        wx, wy = velocities[k, 0] - velocity[0], velocities[k, 1] - velocity[1]
        reach = (width + math.hypot(sizes[k, 0], sizes[k, 1])) / 2
        heading[0], size[0, 0], size[0, 1] = yaws[k], sizes[k, 0], sizes[k, 1]
        for step in range(16):
            t = 0.2 * step
            if t >= least:
                break
            place[0, 0], place[0, 1] = x + dx + wx * t, y + dy + wy * t
            far = math.hypot(dx + wx * t, dy + wy * t) - reach
            if t + per_metre * far >= least:
                continue
            signed_gaps_into((x, y, yaw, length, width), place, heading, size, gap)
            least = min(least, t + per_metre * max(gap[0], 0.0))
    return least


# --- Gaps ----------------------------------------------------------------------------------------

Array = NDArray[np.float64]


def signed_gaps(
    box: tuple[float, float, float, float, float], centres: Array, yaws: Array, sizes: Array
) -> Array:
    """[K] float64 metres from a rectangle to others; below 0 the depth by which they overlap.

    Disjoint convex shapes are nearest at a corner of one of them; the depth is the least over the
    directions of their sides (separating axes, Gottschalk et al. 1996).

    Args:
        box: centre x, y [m], yaw [rad], length, width [m]; one without length is a bumper.
        centres: [K, 2 or 3] [m].
        yaws: [K] [rad].
        sizes: [K, 2 or 3] length and width first [m].
    """
    found: Array = np.empty(len(yaws))
    signed_gaps_into(box, centres, yaws, sizes, found)
    return found


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
