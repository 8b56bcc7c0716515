"""Distances between boxes, in one call."""

from __future__ import annotations

import math

import numpy as np

from .._numba import kernel


@kernel
def signed_gaps_into(box, centres, yaws, sizes, found):
    """See :func:`.gaps.signed_gaps`; into ``found`` [K]."""
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
