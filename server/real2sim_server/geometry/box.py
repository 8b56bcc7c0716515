"""Oriented boxes: corners, depth of overlap, and a compiled overlap test."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._numba import kernel
from .transform import Float, apply_transform

UNIT_CORNERS = np.array(
    [[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], dtype=np.float64
)
"""[8, 3] corners of the unit box: x changes fastest, bottom four first."""

NEXT, SECOND = [1, 2, 0], [2, 0, 1]
"""The coordinates after each, in their cycle."""


def box_corners(T_world_box: ArrayLike, size: ArrayLike) -> Float:
    """Corners [..., 8, 3] [m] in the world of boxes centred on their own origin.

    Args:
        T_world_box: [..., 4, 4] rigid transform.
        size: [..., 3] (length, width, height) along the box's x, y, z [m].

    Order: x changes fastest, then y, then z, from minus to plus.
    """
    local = UNIT_CORNERS * np.asarray(size, dtype=np.float64)[..., None, :]
    return apply_transform(T_world_box, local)


def bottom_centres(T_world_box: Float, size: ArrayLike) -> Float:
    """Centres [N, 3] [m] of the four lowest corners of boxes at ``T_world_box`` [N, 4, 4]."""
    corners = box_corners(T_world_box, size)
    lowest = np.argsort(corners[..., 2], axis=1, kind="stable")[:, :4]
    chosen: Float = np.take_along_axis(corners, lowest[..., None], axis=1)
    centres: Float = chosen.mean(axis=1)
    return centres


def box_penetration(
    T_world_a: ArrayLike, size_a: ArrayLike, T_world_b: ArrayLike, size_b: ArrayLike
) -> Float:
    """Minimum distance [...] [m] to shift one box so that the two no longer overlap.

    For separate boxes it is negative, and its magnitude is a lower bound of their distance.
    Separating-axis test over the 15 candidate axes (Gottschalk et al. 1996, OBBTree). Leading
    dimensions broadcast, so one box can be tested against many.

    Args:
        T_world_a, T_world_b: [..., 4, 4] rigid transforms to the world; origin at the box centre.
        size_a, size_b: [..., 3] (length, width, height) [m].
    """
    turn, centre, half_a, half_b = _relative(T_world_a, size_a, T_world_b, size_b)
    faces = _face_overlaps(turn, centre, half_a, half_b)
    edges = _edge_overlaps(turn, centre, half_a, half_b)
    return np.minimum(faces, edges)


def _relative(
    T_world_a: ArrayLike, size_a: ArrayLike, T_world_b: ArrayLike, size_b: ArrayLike
) -> tuple[Float, Float, Float, Float]:
    """``R_a_b`` [..., 3, 3], centre of b in the frame of a [..., 3, 1], halves of both sizes."""
    a, b = np.asarray(T_world_a, dtype=np.float64), np.asarray(T_world_b, dtype=np.float64)
    half_a = np.asarray(size_a, dtype=np.float64)[..., :, None] / 2
    half_b = np.asarray(size_b, dtype=np.float64)[..., None, :] / 2
    to_a = np.swapaxes(a[..., :3, :3], -1, -2)
    turn = to_a @ b[..., :3, :3]
    centre = to_a @ (b[..., :3, 3:] - a[..., :3, 3:])
    return turn, centre, half_a, half_b


def _face_overlaps(turn: Float, centre: Float, half_a: Float, half_b: Float) -> Float:
    """Least overlap [...] along the face normals of both boxes.

    Args:
        turn: [..., 3, 3] ``R_a_b``.
        centre: [..., 3, 1] of b in the frame of a.
        half_a, half_b: [..., 3, 1] and [..., 1, 3].
    """
    size = np.abs(turn)
    along_a = half_a + (size * half_b).sum(-1, keepdims=True) - np.abs(centre)
    along_b = half_b + (size * half_a).sum(-2, keepdims=True)
    along_b = along_b - np.abs((turn * centre).sum(-2, keepdims=True))
    least: Float = np.minimum(along_a.min((-2, -1)), along_b.min((-2, -1)))
    return least


def _edge_overlaps(turn: Float, centre: Float, half_a: Float, half_b: Float) -> Float:
    """Minimum overlap [...] along the products of an edge of a and one of b; see above.

    Entry [i, j] belongs to the product of a's axis i and b's axis j. In the frame of a it is
    (-turn[i + 2, j], turn[i + 1, j]) in the coordinates i + 1 and i + 2. So the extent of a needs
    these two rows of ``turn``, and the extent of b, seen from b, two columns.
    """
    size = np.abs(turn)
    next_row, second_row = turn[..., NEXT, :], turn[..., SECOND, :]
    gap = np.abs(centre[..., SECOND, :] * next_row - centre[..., NEXT, :] * second_row)
    reach_a = (
        half_a[..., NEXT, :] * size[..., SECOND, :] + half_a[..., SECOND, :] * size[..., NEXT, :]
    )
    reach_b = half_b[..., NEXT] * size[..., SECOND] + half_b[..., SECOND] * size[..., NEXT]
    length = np.sqrt(next_row * next_row + second_row * second_row)
    # Parallel edges span no axis; the face normals cover that case.
    valid = length > 1e-6
    overlaps = np.where(valid, reach_a + reach_b - gap, np.inf) / np.where(valid, length, 1.0)
    least: Float = overlaps.min((-2, -1))
    return least


# Kernels.

MIN_OVERLAP = 1e-9
"""Maximum overlap of boxes that only touch [m]."""

PARALLEL = 1e-6
"""Sine of the angle below which two edges span no axis."""


@kernel
def boxes_overlap(T_world_a: Any, size_a: Any, T_world_b: Any, size_b: Any) -> Any:
    """Whether two boxes share volume; touching boxes do not.

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
def first_overlap(ways: Any, sizes: Any, covered: Any, reach: Any, standing: Any) -> Any:
    """Index of the first of S samples at which two moving boxes share volume; S for none.

    Args:
        ways: of both boxes, two [S, 4, 4] float64, ``T_world_box`` at the same times.
        sizes: of both, (length, width, height) each [m].
        covered: [S] bool, samples at which both exist.
        reach: boxes with a larger distance of centres cannot overlap [m].
        standing: whether both are stationary, so that one sample is enough.
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
def _faces_overlap(turn: Any, centre: Any, half_a: Any, half_b: Any) -> bool:
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
        if reach_a - abs(centre[i]) <= MIN_OVERLAP or reach_b - abs(apart) <= MIN_OVERLAP:
            return False
    return True


@kernel
def _edges_overlap(turn: Any, centre: Any, half_a: Any, half_b: Any) -> bool:
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
            if (reach - gap) / length <= MIN_OVERLAP:
                return False
    return True
