"""Where the recorded drive goes from here: waypoints and a turn command."""

from __future__ import annotations

from typing import Literal

import numpy as np

from .path import Float, LoggedPath

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
    at = s + WAYPOINT_SPACING * np.arange(1, WAYPOINTS + 1)
    east = np.interp(at, path.s, path.positions[:, 0])
    north = np.interp(at, path.s, path.positions[:, 1])
    beyond = np.maximum(at - path.length, 0.0)
    last = path.yaws[-1]
    dx = east + beyond * np.cos(last) - x
    dy = north + beyond * np.sin(last) - y
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=1)


def command_ahead(path: LoggedPath, s: float) -> Command:
    """Which way the path turns over the next 25 m."""
    here, there = np.interp([s, s + COMMAND_AHEAD], path.s, path.yaws)
    if there - here > TURN:
        return "left"
    if there - here < -TURN:
        return "right"
    return "straight"
