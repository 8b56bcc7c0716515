"""Contact at one grid node: where surfaces are, and what a touch does to velocities."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .shared import F32, ONE, TINY, ZERO, law

REACH = F32(1.5)
"""Half width of the spline: a node sees matter up to this many cells away."""
_ENTRIES = 256


def _surface_table() -> Any:
    """Surface offset [cells] by centroid offset, for matter that fills u > surface at a node.

    The centroid of N(u) over (s, 1.5) grows with s; the table is its inverse at even steps.
    """
    u = np.linspace(-1.5, 1.5, 60_001)
    a = np.abs(u)
    n = np.where(a < 0.5, 0.75 - a**2, 0.5 * (1.5 - a) ** 2)
    mass = np.cumsum(n[::-1])[::-1]
    centroid = np.cumsum((u * n)[::-1])[::-1] / np.maximum(mass, 1e-300)
    centroid[-1] = 1.5
    even = np.linspace(0.0, 1.5, _ENTRIES + 1)
    return np.interp(even, centroid, u).astype(np.float32)


SURFACE = _surface_table()


@law
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


@law
def coulomb(v: Any, n: Any, friction: Any, separable: Any) -> Any:
    """Relative velocity after a touch: no approach along ``n``, Coulomb friction across it.

    Args:
        v: velocity relative to the obstacle, three numbers.
        n: unit normal out of the obstacle.
        friction: Coulomb coefficient; infinity sticks.
        separable: false keeps the normal velocity at zero when it points away, too.

    v_t' = max(0, 1 - mu |v_n| / |v_t|) v_t. Takes kinetic energy or leaves it, never adds any.
    """
    approach = v[0] * n[0] + v[1] * n[1] + v[2] * n[2]
    if approach >= ZERO and separable:
        return v
    t = (v[0] - approach * n[0], v[1] - approach * n[1], v[2] - approach * n[2])
    speed = math.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    keep = ZERO * speed
    if speed > TINY:
        keep = max(ONE - friction * abs(approach) / speed, ZERO * speed)
    return keep * t[0], keep * t[1], keep * t[2]
