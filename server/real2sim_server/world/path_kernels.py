"""Questions to a path, each answered in one call.

All take the path as ``knots`` [P, 11] float64, one row a pose: its distance from the start [m],
position x, y, z [m], heading (continuous) [rad], floor normal [3], and for the segment to the next
pose the two parts of the complex number whose product with (p - start) has the share of the
segment that lies before p's foot as its real part, and p's distance to the left as its imaginary
part, both in lengths of the segment; last the square of that length [m^2].
"""

from __future__ import annotations

import math

import numpy as np

from ..scene.compiled import compiled

KNOT = 11

NEAR_BEHIND, NEAR_AHEAD = 20.0, 60.0
"""Where along the path a vehicle is looked for first, from where it was last [m]."""

LOST = 10.0
"""Farther from the path than this, the whole of it is searched [m]."""


@compiled
def nearest_point(knots, x, y, near_s):
    """The nearest point of the path to (x, y) [m].

    Args:
        knots: see above.
        x, y: world [m].
        near_s: distance along the path of the part to look at first [m]; NaN for none.

    Returns:
        Distance along the path [m], distance from it, positive on its left and beyond its ends
        from the straight line on [m], position (x, y, z) [m], heading [rad], unit normal of the
        floor.
    """
    segments = len(knots) - 1
    k, share, offset = 0, 0.0, math.inf
    if not math.isnan(near_s):
        first = max(_first_not_before(knots, near_s - NEAR_BEHIND) - 1, 0)
        last = min(max(_first_not_before(knots, near_s + NEAR_AHEAD), first + 1), segments)
        k, share, offset = _foot(knots, x, y, first, last)
    if not abs(offset) <= LOST:
        k, share, offset = _foot(knots, x, y, 0, segments)
    a, b, rest = knots[k], knots[k + 1], 1.0 - share
    if (k == 0 and share == 0.0) or (k == segments - 1 and share == 1.0):
        offset = ((x - a[1]) * a[9] + (y - a[2]) * a[8]) * math.sqrt(a[10])
    ux, uy, uz = rest * a[5] + share * b[5], rest * a[6] + share * b[6], rest * a[7] + share * b[7]
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    return (
        rest * a[0] + share * b[0],
        offset,
        (rest * a[1] + share * b[1], rest * a[2] + share * b[2], rest * a[3] + share * b[3]),
        rest * a[4] + share * b[4],
        (ux / length, uy / length, uz / length),
    )


@compiled
def waypoints(knots, s, pose, count, spacing):
    """Places along the path, seen from a vehicle; beyond its end the path goes straight on.

    Args:
        knots: see above.
        s: where along the path they begin [m].
        pose: x, y [m], yaw [rad] of the vehicle in the world.
        count: of them.
        spacing: along the path, also from ``s`` to the first one [m].

    Returns:
        [count, 2] float64 in the vehicle frame [m].
    """
    x, y, yaw = pose
    end = knots[len(knots) - 1]
    ahead_x, ahead_y = math.cos(end[4]), math.sin(end[4])
    cos, sin = math.cos(yaw), math.sin(yaw)
    found = np.empty((count, 2))
    for i in range(count):
        at = s + spacing * (i + 1)
        beyond = max(at - end[0], 0.0)
        dx = _along(knots, at, 1) + beyond * ahead_x - x
        dy = _along(knots, at, 2) + beyond * ahead_y - y
        found[i, 0], found[i, 1] = cos * dx + sin * dy, cos * dy - sin * dx
    return found


@compiled
def turn_between(knots, here, there):
    """Change of heading [rad] between two distances along the path [m]."""
    return _along(knots, there, 4) - _along(knots, here, 4)


@compiled
def _first_not_before(knots, s):
    """Number of the first pose at distance ``s`` or farther; that of poses where there is none."""
    low, high = 0, len(knots)
    while low < high:
        middle = (low + high) // 2
        if knots[middle, 0] < s:
            low = middle + 1
        else:
            high = middle
    return low


@compiled
def _along(knots, s, column):
    """A column of the path at distance ``s``, linear between poses, constant beyond both ends."""
    after = _first_not_before(knots, s)
    if after == 0:
        return knots[0, column]
    if after == len(knots):
        return knots[after - 1, column]
    a, b = knots[after - 1], knots[after]
    return a[column] + (b[column] - a[column]) / (b[0] - a[0]) * (s - a[0])


@compiled
def _foot(knots, x, y, first, last):
    """Nearest segment from ``first`` to before ``last``, share of it, and the distance from there,
    positive on the left [m]."""
    nearest, least, share, left = first, math.inf, 0.0, 0.0
    for k in range(first, last):
        dx, dy = x - knots[k, 1], y - knots[k, 2]
        along = dx * knots[k, 8] - dy * knots[k, 9]
        across = dx * knots[k, 9] + dy * knots[k, 8]
        foot = min(max(along, 0.0), 1.0)
        beyond = along - foot
        square = (beyond * beyond + across * across) * knots[k, 10]
        if square < least:
            nearest, least, share, left = k, square, foot, across
    return nearest, share, math.copysign(math.sqrt(least), left)
