"""Poses of many trajectories at one instant, in one call."""

from __future__ import annotations

import math

import numpy as np

from .._numba import kernel

KNOT = 11
"""Numbers of a knot: position [3], quaternion wxyz [4], velocity [3], and whether the quaternion
of the next knot is another one."""


@kernel
def poses_at(t_us, ends, times, knots):
    """Poses and velocities of the trajectories that cover an instant, K of N.

    Args:
        t_us: int64 [us].
        ends: [N + 1] int64; trajectory k has the knots from ``ends[k]`` to ``ends[k + 1]``.
        times: [M] int64, of all knots, increasing within each trajectory [us].
        knots: [M, 11] float64, see ``KNOT``; [m], [m/s].

    Returns:
        Numbers of the trajectories [K] int64, and in float64 positions [K, 3], quaternions
        [K, 4], velocities [K, 3] and transforms [K, 4, 4]. At a knot its pose, bit for bit.
    """
    known, after = _covering(t_us, ends, times)
    count = len(known)
    positions, quaternions = np.empty((count, 3)), np.empty((count, 4))
    velocities, transforms = np.empty((count, 3)), np.empty((count, 4, 4))
    for k in range(count):
        j = after[k]
        i = j if times[j] == t_us else j - 1
        fraction = (t_us - times[i]) / (times[j] - times[i]) if i < j else 0.0
        for c in range(3):
            positions[k, c] = (1 - fraction) * knots[i, c] + fraction * knots[j, c]
            velocities[k, c] = knots[i, 7 + c]
        if fraction > 0 and knots[i, 10] != 0:
            _slerp(knots[i], knots[j], fraction, quaternions[k])
        else:
            for c in range(4):
                quaternions[k, c] = knots[i, 3 + c]
        _put(positions[k], quaternions[k], transforms[k])
    return known, positions, quaternions, velocities, transforms


@kernel
def _covering(t_us, ends, times):
    """Trajectories that cover ``t_us`` [K], and the first knot of each that is not before it."""
    known, after = np.empty(len(ends) - 1, np.int64), np.empty(len(ends) - 1, np.int64)
    count = 0
    for k in range(len(ends) - 1):
        low, high = ends[k], ends[k + 1]
        if times[low] > t_us or times[high - 1] < t_us:
            continue
        while low < high:
            middle = (low + high) // 2
            if times[middle] < t_us:
                low = middle + 1
            else:
                high = middle
        known[count], after[count] = k, low
        count += 1
    return known[:count], after[:count]


@kernel
def _slerp(start, end, fraction, found):
    """Quaternion [4] between two knots, on the shorter arc; as ``scene.rotation.slerp``."""
    dot = 0.0
    for c in range(3, 7):
        dot += start[c] * end[c]
    sign = -1.0 if dot < 0 else 1.0
    angle = math.acos(min(abs(dot), 1.0))
    sine = math.sin(angle)
    a, b = 1 - fraction, fraction
    if sine >= 1e-6:
        a, b = math.sin(a * angle) / sine, math.sin(b * angle) / sine
    squares = 0.0
    for c in range(4):
        found[c] = a * start[3 + c] + b * sign * end[3 + c]
        squares += found[c] * found[c]
    length = math.sqrt(squares)
    for c in range(4):
        found[c] /= length


@kernel
def _put(position, quaternion, transform):
    """``T_world_object`` [4, 4] of a position [3] and a unit quaternion [4]."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    transform[0, 0] = w * w + x * x - y * y - z * z
    transform[1, 1] = w * w - x * x + y * y - z * z
    transform[2, 2] = w * w - x * x - y * y + z * z
    transform[0, 1], transform[1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    transform[0, 2], transform[2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    transform[1, 2], transform[2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    for c in range(3):
        transform[c, 3], transform[3, c] = position[c], 0.0
    transform[3, 3] = 1.0
