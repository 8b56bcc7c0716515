"""Lanes beside the ego's route, in which road users drive that have no way of their own."""

from __future__ import annotations

import math

import numpy as np

from ..path import LoggedPath

STRAIGHT = 600.0
"""Lanes begin so far before the route and end so far behind it, straight on [m]."""


def lane_beside(route: LoggedPath, offset: float, *, oncoming: bool = False) -> LoggedPath:
    """The lane ``offset`` metres to the left of a route; ``oncoming``: against it."""
    (x, y, z), (ex, ey, ez) = route.positions[0].tolist(), route.positions[-1].tolist()
    first, last = float(route.yaws[0]), float(route.yaws[-1])
    start = [x - STRAIGHT * math.cos(first), y - STRAIGHT * math.sin(first), z]
    end = [ex + STRAIGHT * math.cos(last), ey + STRAIGHT * math.sin(last), ez]
    longer = LoggedPath.through(
        np.vstack([start, route.positions, end]),
        np.concatenate([[first], route.yaws, [last]]),
        np.vstack([route.ups[:1], route.ups, route.ups[-1:]]),
    )
    return longer.beside(offset, reverse=oncoming)


def lane_of(route: LoggedPath, x: float, y: float, yaw: float) -> LoggedPath:
    """The lane beside a route in which something is at x, y [m], the way it faces: ``yaw``."""
    near = route.nearest(x, y)
    return lane_beside(route, near.offset, oncoming=math.cos(yaw - near.yaw) < 0.0)
