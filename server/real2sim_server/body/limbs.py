"""Limbs put where they shall be: directions of bones, and two bones between given ends.

Everything is of many instants at once: points and directions [T, 3], rotations [T, 3, 3].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..geometry.transform import Float

UP = np.array([0.0, 0.0, 1.0])
LATERAL = np.array([0.0, 1.0, 0.0])


def unit(v: Float) -> Float:
    """Directions [..., 3] of vectors."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)  # type: ignore[no-any-return]


def about(axis: ArrayLike, angle: ArrayLike) -> Float:
    """Rotations [..., 3, 3] about a unit axis [3] by angles [...] (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.asarray(angle, dtype=np.float64)[..., None, None]
    turned: Float = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return turned


def aim(start: ArrayLike, end: Float) -> Float:
    """The shortest rotations [T, 3, 3] that take directions [3] or [T, 3] to directions [T, 3]."""
    a, b = np.broadcast_arrays(unit(np.asarray(start, dtype=np.float64)), unit(end))
    v, c = np.cross(a, b), (a * b).sum(axis=-1)
    cross = np.zeros((*v.shape[:-1], 3, 3))
    cross[..., 0, 1], cross[..., 0, 2] = -v[..., 2], v[..., 1]
    cross[..., 1, 0], cross[..., 1, 2] = v[..., 2], -v[..., 0]
    cross[..., 2, 0], cross[..., 2, 1] = -v[..., 1], v[..., 0]
    scale = 1.0 / np.maximum(1.0 + c, 1e-6)
    turned: Float = np.eye(3) + cross + (cross @ cross) * scale[..., None, None]
    return turned


def frame(along: Float, lateral: Float) -> Float:
    """Right-handed frames [..., 3, 3], columns: along, lateral made square to it, the third."""
    along = unit(along)
    square = unit(lateral - (lateral * along).sum(axis=-1, keepdims=True) * along)
    return np.stack([along, square, np.cross(along, square)], axis=-1)


def partial_turn(rotations: Float, fraction: float) -> Float:
    """The rotations [T, 3, 3] by a fraction of their angles, about their own axes."""
    trace = np.trace(rotations, axis1=-2, axis2=-1)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    skew = (rotations - np.swapaxes(rotations, -1, -2)) / 2
    axis = skew / np.maximum(np.sin(angle), 1e-9)[..., None, None]
    part = (angle * fraction)[..., None, None]
    turned: Float = np.eye(3) + np.sin(part) * axis + (1 - np.cos(part)) * (axis @ axis)
    return turned


def bend(start: Float, end: Float, upper: float, lower: float, towards: Float) -> Float:
    """Where the middle joint [T, 3] of two bones is.

    Args:
        start, end: of the limb [T, 3]; what is out of reach is met by a straight limb.
        upper, lower: lengths of its bones [m].
        towards: [T, 3], which way the middle joint points.
    """
    line = end - start
    reach = np.clip(
        np.linalg.norm(line, axis=-1), abs(upper - lower) + 1e-6, (upper + lower) * (1 - 1e-9)
    )
    along = unit(line)
    aside = unit(towards - (towards * along).sum(axis=-1, keepdims=True) * along)
    ahead = (upper**2 - lower**2 + reach**2) / (2 * reach)
    off = np.sqrt(np.maximum(upper**2 - ahead**2, 0.0))
    return start + ahead[..., None] * along + off[..., None] * aside  # type: ignore[no-any-return]


def smooth(x: ArrayLike) -> Float:
    """From 0 to 1 over [0, 1], level at both ends."""
    x = np.clip(np.asarray(x, dtype=np.float64), 0.0, 1.0)
    return x * x * (3 - 2 * x)  # type: ignore[no-any-return]
