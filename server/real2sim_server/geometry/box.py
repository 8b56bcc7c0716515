"""Oriented boxes: corners and depth of overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

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
    """Shortest distance [...] [m] to shift one box so that the two no longer overlap.

    Negative where they are apart; then it is a lower bound of the distance between them, with
    the sign turned. Separating-axis test over the 15 candidate axes (Gottschalk et al. 1996,
    OBBTree). Leading dimensions broadcast, so one box can be tested against many.

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
    """Least overlap [...] along the products of an edge of a and one of b; see above.

    Entry [i, j] of what follows belongs to the product of a's axis i and b's axis j. In the frame
    of a it is (-turn[i + 2, j], turn[i + 1, j]) in the coordinates i + 1 and i + 2, so that the
    reach of a needs these two rows of ``turn``, and that of b, seen from b, two columns.
    """
    size = np.abs(turn)
    next_row, second_row = turn[..., NEXT, :], turn[..., SECOND, :]
    gap = np.abs(centre[..., SECOND, :] * next_row - centre[..., NEXT, :] * second_row)
    reach_a = (
        half_a[..., NEXT, :] * size[..., SECOND, :] + half_a[..., SECOND, :] * size[..., NEXT, :]
    )
    reach_b = half_b[..., NEXT] * size[..., SECOND] + half_b[..., SECOND] * size[..., NEXT]
    length = np.sqrt(next_row * next_row + second_row * second_row)
    # Parallel edges span no axis of their own; the face normals cover that case.
    valid = length > 1e-6
    overlaps = np.where(valid, reach_a + reach_b - gap, np.inf) / np.where(valid, length, 1.0)
    least: Float = overlaps.min((-2, -1))
    return least
