"""Quadratic B-splines."""

from __future__ import annotations

from typing import Any

from .device import HALF, THREE_HALVES, THREE_QUARTERS, device_function


@device_function
def spline_weights(f: Any) -> Any:
    """Weights of the three nodes at offsets 0, 1, 2 for a particle at ``f`` in [0.5, 1.5).

    f is the distance to the first node in cells. Jiang et al. 2016, MPM course, eq. 123.
    """
    left = THREE_HALVES - f
    right = f - HALF
    middle = right - HALF
    return HALF * left * left, THREE_QUARTERS - middle * middle, HALF * right * right
