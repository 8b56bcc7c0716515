"""Oriented boxes: corners and overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .rotation import Float, apply_transform

UNIT_CORNERS = np.array(
    [[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], dtype=np.float64
)
"""[8, 3] corners of the unit box: x changes fastest, bottom four first."""


def box_corners(T_world_box: ArrayLike, size: ArrayLike) -> Float:
    """Corners [..., 8, 3] [m] in the world of boxes centred on their own origin.

    Args:
        T_world_box: [..., 4, 4] rigid transform.
        size: [..., 3] (length, width, height) along the box's x, y, z [m].

    Order: x changes fastest, then y, then z, from minus to plus.
    """
    local = UNIT_CORNERS * np.asarray(size, dtype=np.float64)[..., None, :]
    return apply_transform(T_world_box, local)


def boxes_overlap(
    T_world_a: ArrayLike, size_a: ArrayLike, T_world_b: ArrayLike, size_b: ArrayLike
) -> NDArray[np.bool_]:
    """Whether boxes share volume, [...] bool; boxes that only touch do not.

    Separating-axis test over the 15 candidate axes (Gottschalk et al. 1996, OBBTree). Leading
    dimensions broadcast, so one box can be tested against many.

    Args:
        T_world_a, T_world_b: [..., 4, 4] rigid transforms to the world; origin at the box centre.
        size_a, size_b: [..., 3] (length, width, height) [m].
    """
    return box_penetration(T_world_a, size_a, T_world_b, size_b) > 1e-9


def box_penetration(
    T_world_a: ArrayLike, size_a: ArrayLike, T_world_b: ArrayLike, size_b: ArrayLike
) -> Float:
    """Shortest distance [...] [m] to shift one box so that the two no longer overlap.

    Negative where they are apart; then it is a lower bound of the distance between them, with
    the sign turned. Arguments as in :func:`boxes_overlap`.
    """
    a, b = np.asarray(T_world_a, dtype=np.float64), np.asarray(T_world_b, dtype=np.float64)
    half_a = np.asarray(size_a, dtype=np.float64) / 2
    half_b = np.asarray(size_b, dtype=np.float64) / 2
    rotation_a, rotation_b = np.broadcast_arrays(a[..., :3, :3], b[..., :3, :3])
    axes, valid = _candidate_axes(rotation_a, rotation_b)
    centre = b[..., :3, 3] - a[..., :3, 3]
    gap = np.abs(np.einsum("...ki,...i->...k", axes, centre))
    reach = _reach(axes, rotation_a, half_a) + _reach(axes, rotation_b, half_b)
    return np.where(valid, reach - gap, np.inf).min(axis=-1)


def _candidate_axes(rotation_a: Float, rotation_b: Float) -> tuple[Float, NDArray[np.bool_]]:
    """Unit axes [..., 15, 3]: face normals of both and their cross products; which are usable."""
    normals_a, normals_b = np.swapaxes(rotation_a, -1, -2), np.swapaxes(rotation_b, -1, -2)
    crossed = np.cross(normals_a[..., :, None, :], normals_b[..., None, :, :])
    crossed = crossed.reshape(*crossed.shape[:-3], 9, 3)
    axes = np.concatenate([normals_a, normals_b, crossed], axis=-2)
    length = np.linalg.norm(axes, axis=-1)
    # Parallel edges span no axis of their own; the face normals cover that case.
    valid = length > 1e-6
    return axes / np.where(valid, length, 1.0)[..., None], valid


def _reach(axes: Float, rotation: Float, half: Float) -> Float:
    """Half extent [..., 15] of a box along each axis."""
    along = np.abs(np.einsum("...ki,...ij->...kj", axes, rotation))
    return np.einsum("...kj,...j->...k", along, half)
