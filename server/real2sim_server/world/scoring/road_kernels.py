"""How far a box is off the road, in one call."""

from __future__ import annotations

import math

import numpy as np

from ..._numba import kernel

DENSITY = 0.25
"""Distance between points of the lines that roads are made of [m]."""

LONGEST_SPACING = DENSITY * (1 + 1e-9)
"""Spacings exceed ``DENSITY`` by rounding; the margin keeps the search exact [m]."""


@kernel
def off_road(middle, size, route, lanes, half_widths):
    """How far a box is off the road, and how many of its quarters have their middle on it.

    The road is all that lies within half a width of a line.

    Args:
        middle: x, y [m], yaw [rad] of the box.
        size: (length, width, height) of it [m].
        route: points [R, 2] float64 and their ends [n] int64: line k has the points from the end
            before to ``ends[k]``, each at most ``DENSITY`` from the one before [m].
        lanes: other lines in the same form; there may be none.
        half_widths: along the route and along the lanes [m].

    Returns:
        How far its worst corner is off the road [m], 0 and less on it; 0 to 4 quarters.
    """
    x, y, yaw = middle
    cos, sin = math.cos(yaw), math.sin(yaw)
    points, beyond = np.empty((8, 2)), np.empty(8)
    for k in range(8):
        # Corners and, half as far from the middle of the box, the middles of its quarters.
        far = 0.5 if k < 4 else 0.25
        u = far * size[0] if k % 4 < 2 else -far * size[0]
        v = far * size[1] if 0 < k % 4 < 3 else -far * size[1]
        points[k, 0], points[k, 1] = x + u * cos - v * sin, y + u * sin + v * cos
        beyond[k] = math.inf
    _narrow(beyond, points, route, half_widths[0])
    if beyond.max() > 0 and len(lanes[1]):
        _narrow(beyond, points, lanes, half_widths[1])
    inside = 0
    for k in range(4, 8):
        inside += beyond[k] <= 0
    return max(beyond[0], beyond[1], beyond[2], beyond[3]), inside


@kernel
def in_lane(place, lines, half_width):
    """Whether a place lies within half a width [m] of a line that goes on in its direction.

    Args:
        place: x, y [m], yaw [rad].
        lines: as in :func:`off_road`; there may be none.
        half_width: of each lane [m].
    """
    points, ends = lines
    x, y, yaw = place
    cos, sin = math.cos(yaw), math.sin(yaw)
    begin = 0
    for end in ends:
        for k in range(begin, end - 1):
            dx, dy = points[k, 0] - x, points[k, 1] - y
            if dx * dx + dy * dy <= half_width * half_width:
                on_x, on_y = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
                if on_x * cos + on_y * sin > 0.0:
                    return True
        begin = end
    return False


@kernel
def _narrow(beyond, places, lines, half_width):
    """Lower ``beyond`` [P] [m] to how far places [P, 2] [m] are off the strips along lines."""
    distance = math.inf
    for k in range(len(places)):
        x, y = places[k, 0], places[k, 1]
        if k == 0:
            bound = _rough_distance(x, y, lines[0])
        else:
            bound = distance + math.hypot(x - places[k - 1, 0], y - places[k - 1, 1])
        distance = _distance(x, y, lines, bound)
        beyond[k] = min(beyond[k], distance - half_width)


@kernel
def _rough_distance(x, y, points):
    """Distance [m] from (x, y) to the nearest of every 64th point."""
    least = math.inf
    for k in range(0, len(points), 64):
        dx, dy = points[k, 0] - x, points[k, 1] - y
        least = min(least, dx * dx + dy * dy)
    return math.sqrt(least)


@kernel
def _distance(x, y, lines, bound):
    """Distance [m] from (x, y) to the nearest point of lines, which is at most ``bound``.

    Where a point is farther away than the nearest one so far, as many of those after it are
    skipped as cannot be nearer, since each is at most ``DENSITY`` from the one before.
    """
    points, ends = lines
    best, k = bound, 0
    for end in ends:
        while k < end:
            dx, dy = points[k, 0] - x, points[k, 1] - y
            distance = math.sqrt(dx * dx + dy * dy)
            best = min(best, distance)
            k += max(int((distance - best) / LONGEST_SPACING), 1)
        k = end
    return best
