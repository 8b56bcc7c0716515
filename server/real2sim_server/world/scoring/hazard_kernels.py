"""First overlap of a box with others at constant velocity, in one call."""
# ruff: noqa: PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import math

from ..._numba import kernel

HORIZON, STEP = 3.0, 0.1
STEPS = 31
"""Times from 0 to the horizon."""

AHEAD, BEHIND = math.radians(30), math.radians(150)
"""Bearings within which an object counts as ahead, beyond which as behind (nuPlan)."""


@kernel
def first_overlap_step(ego, size, centre_ahead, everywhere, others, ignored):
    """The first step of 0.1 s up to 3 s at which the ego box overlaps that of an object.

    Args:
        ego: x, y [m], yaw [rad], speed, lateral speed [m/s] of the rear axle, height of the
            ground z [m].
        size: (length, width, height) of its box [m].
        centre_ahead: rear axle to the middle of the box [m].
        everywhere: whether all objects count that are not behind the ego; else those ahead.
        others: centres [K, 3] [m], yaws [K] [rad], sizes [K, 3] [m], velocities [K, 2] [m/s] of
            the objects, float64, world.
        ignored: [K] bool, objects that do not count.

    Returns:
        Number of steps; -1 where they do not overlap.
    """
    x, y, yaw, forward, lateral, z = ego
    centres, yaws, sizes, velocities = others
    cos, sin = math.cos(yaw), math.sin(yaw)
    vx, vy = forward * cos - lateral * sin, forward * sin + lateral * cos
    middle_x, middle_y = x + centre_ahead * cos, y + centre_ahead * sin
    first = STEPS
    for k in range(len(yaws)):
        if ignored[k]:
            continue
        low = centres[k, 2] - sizes[k, 2] / 2
        if low >= z + size[2] or low + sizes[k, 2] <= z:
            continue
        dx, dy = centres[k, 0] - middle_x, centres[k, 1] - middle_y
        wx, wy = velocities[k, 0] - vx, velocities[k, 1] - vy
        reach = (math.hypot(size[0], size[1]) + math.hypot(sizes[k, 0], sizes[k, 1])) / 2
        if _closest(dx, dy, wx, wy) >= reach:
            continue
        bearing = math.atan2(centres[k, 1] - y, centres[k, 0] - x) - yaw
        bearing = abs((bearing + math.pi) % math.tau - math.pi)
        if bearing >= AHEAD and not (everywhere and bearing <= BEHIND):
            continue
        for step in range(first):
            t = step * STEP
            apart_x = centres[k, 0] + velocities[k, 0] * t - (middle_x + vx * t)
            apart_y = centres[k, 1] + velocities[k, 1] * t - (middle_y + vy * t)
            if _overlap(apart_x, apart_y, yaw, size, yaws[k], sizes[k]):
                first = step
                break
    return first if first < STEPS else -1


@kernel
def _closest(x, y, vx, vy):
    """Smallest distance [m] within the horizon of a point at (x, y) [m] that moves [m/s]."""
    squared = max(vx * vx + vy * vy, 1e-12)
    t = min(max(-(x * vx + y * vy) / squared, 0.0), HORIZON)
    return math.hypot(x + vx * t, y + vy * t)


@kernel
def _overlap(x, y, yaw, size, other_yaw, other_size):
    """Whether two boxes overlap on the plane, the second's middle being (x, y) off: separating
    axes."""
    cos_a, sin_a = math.cos(yaw), math.sin(yaw)
    cos_b, sin_b = math.cos(other_yaw), math.sin(other_yaw)
    turn = other_yaw - yaw
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    la, wa, lb, wb = size[0], size[1], other_size[0], other_size[1]
    return (
        abs(x * cos_a + y * sin_a) < (la + lb * c + wb * s) / 2
        and abs(y * cos_a - x * sin_a) < (wa + lb * s + wb * c) / 2
        and abs(x * cos_b + y * sin_b) < (lb + la * c + wa * s) / 2
        and abs(y * cos_b - x * sin_b) < (wb + la * s + wa * c) / 2
    )
