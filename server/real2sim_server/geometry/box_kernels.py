"""Overlap of two oriented boxes in compiled code, for those who test pair after pair."""

from __future__ import annotations

import math

import numpy as np

from .._numba import kernel

LEAST_OVERLAP = 1e-9
"""Boxes that overlap by no more than this only touch [m]."""

PARALLEL = 1e-6
"""Sine of the angle below which two edges span no axis of their own."""


@kernel
def boxes_overlap(T_world_a, size_a, T_world_b, size_b):
    """Whether two boxes share volume; boxes that only touch do not.

    Separating-axis test over the same axes as :func:`~.box.box_penetration`.

    Args:
        T_world_a, T_world_b: [4, 4] float64, origin at the box centre [m].
        size_a, size_b: (length, width, height), three float64 each [m].
    """
    turn, centre = np.empty((3, 3)), np.empty(3)
    half_a, half_b = np.empty(3), np.empty(3)
    for i in range(3):
        half_a[i], half_b[i] = size_a[i] / 2, size_b[i] / 2
        centre[i] = 0.0
        for c in range(3):
            centre[i] += T_world_a[c, i] * (T_world_b[c, 3] - T_world_a[c, 3])
        for j in range(3):
            turn[i, j] = 0.0
            for c in range(3):
                turn[i, j] += T_world_a[c, i] * T_world_b[c, j]
    return _faces_overlap(turn, centre, half_a, half_b) and _edges_overlap(
        turn, centre, half_a, half_b
    )


@kernel
def first_overlap(ways, sizes, covered, reach, standing):
    """Number of the first of S samples at which two boxes on their ways share volume; S for none.

    Args:
        ways: of both boxes, two [S, 4, 4] float64, ``T_world_box`` at the same times.
        sizes: of both, (length, width, height) each [m].
        covered: [S] bool, where there are both.
        reach: boxes whose centres are farther apart cannot overlap [m].
        standing: whether both stand, so that one sample tells all.
    """
    one, other = ways
    for s in range(len(one)):
        if not covered[s]:
            continue
        squares = 0.0
        for c in range(3):
            between = one[s, c, 3] - other[s, c, 3]
            squares += between * between
        if squares <= reach * reach and boxes_overlap(one[s], sizes[0], other[s], sizes[1]):
            return s
        if standing:
            break
    return len(one)


@kernel
def _faces_overlap(turn, centre, half_a, half_b):
    """Whether two boxes overlap along the normals of the faces of both.

    Args:
        turn: [3, 3] ``R_a_b``.
        centre: [3] of b in the frame of a [m].
        half_a, half_b: [3] half sizes [m].
    """
    for i in range(3):
        reach_a, reach_b = half_a[i], half_b[i]
        apart = 0.0
        for j in range(3):
            reach_a += abs(turn[i, j]) * half_b[j]
            reach_b += abs(turn[j, i]) * half_a[j]
            apart += turn[j, i] * centre[j]
        if reach_a - abs(centre[i]) <= LEAST_OVERLAP or reach_b - abs(apart) <= LEAST_OVERLAP:
            return False
    return True


@kernel
def _edges_overlap(turn, centre, half_a, half_b):
    """Whether two boxes overlap along the products of an edge of each; see above.

    The product of a's axis i and b's axis j is (-turn[i + 2, j], turn[i + 1, j]) in a's
    coordinates i + 1 and i + 2.
    """
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            length = math.sqrt(turn[i1, j] * turn[i1, j] + turn[i2, j] * turn[i2, j])
            if length <= PARALLEL:
                continue
            gap = abs(centre[i2] * turn[i1, j] - centre[i1] * turn[i2, j])
            reach = half_a[i1] * abs(turn[i2, j]) + half_a[i2] * abs(turn[i1, j])
            reach += half_b[j1] * abs(turn[i, j2]) + half_b[j2] * abs(turn[i, j1])
            if (reach - gap) / length <= LEAST_OVERLAP:
                return False
    return True
