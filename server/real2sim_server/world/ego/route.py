"""Where the recorded drive goes from here: waypoints and a turn command."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..path import Float, LoggedPath, turn_between, waypoints

ROUTE_SPACING, ROUTE_POINTS = 1.0, 4096
"""Of a whole route: way from point to point [m], and how many points it has at most."""

Command = Literal["straight", "left", "right"]

WAYPOINTS = 20
WAYPOINT_SPACING = 2.0
"""Distance along the path between waypoints; the first lies this far ahead [m]."""

COMMAND_AHEAD = 25.0
"""The command looks at the heading this far ahead [m]."""

TURN = 0.35
"""A change of heading beyond this is a turn [rad]."""


def route_ahead(path: LoggedPath, s: float, x: float, y: float, yaw: float) -> Float:
    """Waypoints [20, 2] in the vehicle frame [m] along the path ahead of distance ``s``.

    Where the recording ends, the route goes straight on.

    Args:
        path: the recorded way.
        s: where the vehicle is along it [m].
        x, y, yaw: vehicle in the world [m], [rad].
    """
    found: Float = waypoints(path.knots, s, (x, y, yaw), WAYPOINTS, WAYPOINT_SPACING)
    return found


def whole_route(path: LoggedPath) -> Float:
    """[N, 4] float64, x, y, z [m] and heading [rad] along a path from its start to its end."""
    count = min(max(round(path.length / ROUTE_SPACING), 1), ROUTE_POINTS - 1) + 1
    return np.array([path.at(s) for s in np.linspace(0.0, path.length, count).tolist()])


def command_ahead(path: LoggedPath, s: float) -> Command:
    """Which way the path turns over the next 25 m."""
    turn = turn_between(path.knots, s, s + COMMAND_AHEAD)
    if turn > TURN:
        return "left"
    return "right" if turn < -TURN else "straight"
