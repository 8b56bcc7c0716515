"""The leading object on a path."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..path import LoggedPath
from ..path_kernels import next_in_strip
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
