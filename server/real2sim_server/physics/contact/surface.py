"""Contact at one grid node: where surfaces are, and what contact does to velocities."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..numerics.device import F32, ONE, TINY, ZERO, device_function

REACH = F32(1.5)
"""Half width of the spline: a node sees particles up to this many cells away."""
_ENTRIES = 256
STICKS = F32(1e6)
"""Stands for infinite friction, which times no pressure would be no number."""


def _half_space_tables() -> Any:
    """What a node sees of a body that fills u > surface, as the surface passes it [cells].

    Two tables at even steps: surface by centroid in [0, 1.5], and first moment by filled fraction.
    """
    u = np.linspace(-1.5, 1.5, 60_001)
    a = np.abs(u)
    n = np.where(a < 0.5, 0.75 - a**2, 0.5 * (1.5 - a) ** 2) * (u[1] - u[0])
    filled = np.cumsum(n[::-1])[::-1]
    moment = np.cumsum((u * n)[::-1])[::-1]
    centroid = moment / np.maximum(filled, 1e-300)
    centroid[-1] = 1.5
    even = np.linspace(0.0, 1.0, _ENTRIES + 1)
    surface = np.interp(1.5 * even, centroid, u)
    return surface.astype(np.float32), np.interp(even, filled[::-1], moment[::-1]).astype(
        np.float32
    )


SURFACE, FLAT_MOMENT = _half_space_tables()
OPPOSED = F32(0.5)
"""Surfaces are in contact only where the cosine between their normals is beyond this."""
INSIDE = F32(0.25)
"""A body whose centroid is this near a node is all around it, and has no normal there [cells]."""
CRUSHED = F32(1.1)
"""Volumes at rest that what has been crushed has in a cell, at least; a whole body that slides past
a node is all around it too, but as dense as it was."""


@device_function
def surface_offset(centroid: Any) -> Any:
    """Where a body's surface lies along its inward normal, seen from a node [cells].

    Args:
        centroid: offset of the centroid of the body's mass near the node [cells], inwards.

    The body is taken as a half-space. Deep inside this is -1.5: further than the node can see.
    """
    if centroid <= ZERO:
        return -REACH + ZERO * centroid
    scaled = min(centroid / REACH, ONE) * F32(_ENTRIES)
    index = min(int(scaled), _ENTRIES - 1)
    fraction = scaled - F32(index)
    low, high = SURFACE[index], SURFACE[index + 1]
    return low + fraction * (high - low)


@device_function
def face_score(moment: Any, filled: Any) -> Any:
    """How well a body's first moment [cells] tells the normal: how large, and how like a face.

    Args:
        moment: length of the first moment of the filled fraction.
        filled: filled fraction of the node's surroundings.

    Among bodies of one filled a face has the largest moment; edges and corners have less.
    """
    scaled = min(filled, ONE) * F32(_ENTRIES)
    index = min(int(scaled), _ENTRIES - 1)
    fraction = scaled - F32(index)
    flat = FLAT_MOMENT[index] + fraction * (FLAT_MOMENT[index + 1] - FLAT_MOMENT[index])
    # More than a face is no face: what is packed has large moments and is filled more than whole.
    likeness = min(moment / max(flat, F32(1e-3)), ONE)
    return likeness * likeness * moment


@device_function
def coulomb(v: Any, n: Any, friction: Any, separable: Any) -> Any:
    """Relative velocity after contact: no approach along ``n``, Coulomb friction across it.

    Args:
        v: velocity relative to the other, three numbers.
        n: unit normal out of the collider_rows.
        friction: Coulomb coefficient; from STICKS on nothing slides.
        separable: false keeps the normal velocity at zero when it points away, too.

    v_t' = max(0, 1 - mu |v_n| / |v_t|) v_t. Takes kinetic energy or leaves it, never adds any.
    """
    approach = v[0] * n[0] + v[1] * n[1] + v[2] * n[2]
    if approach >= ZERO and separable:
        return v
    if friction >= STICKS:
        return ZERO * v[0], ZERO * v[1], ZERO * v[2]
    t = (v[0] - approach * n[0], v[1] - approach * n[1], v[2] - approach * n[2])
    speed = math.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    keep = ZERO * speed
    if speed > TINY:
        keep = max(ONE - friction * abs(approach) / speed, ZERO * speed)
    return keep * t[0], keep * t[1], keep * t[2]
