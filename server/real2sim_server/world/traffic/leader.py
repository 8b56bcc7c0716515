"""The leading object on a path."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..path import LoggedPath
from ..path_kernels import next_in_strip, previous_in_strip
from .driver import Surroundings


class Leader(NamedTuple):
    """The nearest body ahead: bumper to bumper [m], and its speed along the path [m/s]."""

    gap: float
    speed: float


def leading_agent(
    path: LoggedPath,
    s: float,
    *,
    offset: float,
    length: float,
    width: float,
    object_id: str,
    surroundings: Surroundings,
) -> Leader | None:
    """The body that is next in the strip an object sweeps along a path.

    Args:
        path: of the object.
        s, offset: of its centre along the path, and from it [m].
        length, width: of its box [m].
        object_id: of the object, which is not its own leader.
        surroundings: everybody.
    """
    box = (float(offset), float(length), float(width))
    gap, speed = next_in_strip(
        path.knots, float(s), box, surroundings.bodies, surroundings.rows.get(object_id, -1)
    )
    return None if math.isinf(gap) else Leader(gap, speed)


class Neighbours(NamedTuple):
    """Who is next before and behind something in a lane; None where nobody is within 80 m."""

    leader: Leader | None
    follower: Leader | None


def neighbours(
    path: LoggedPath,
    s: float,
    *,
    length: float,
    width: float,
    object_id: str,
    surroundings: Surroundings,
) -> Neighbours:
    """Leader and follower that a box would have in the middle of a lane, those among them who have
    begun to change into it.

    Args:
        path: of the lane.
        s: of the middle of the box along it [m].
        length, width: of the box [m].
        object_id: of the object, which is neither.
        surroundings: everybody.
    """
    box, own = (0.0, float(length), float(width)), surroundings.rows.get(object_id, -1)
    now = surroundings.bodies
    then = surroundings.bodies_as_meant
    found = []
    for query in (next_in_strip, previous_in_strip):
        gap, speed = min(query(path.knots, float(s), box, bodies, own) for bodies in (now, then))
        found.append(None if math.isinf(gap) else Leader(gap, speed))
    return Neighbours(*found)
