"""How far boxes are from each other on the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .gap_kernels import signed_gaps_into

Array = NDArray[np.float64]


def signed_gaps(
    box: tuple[float, float, float, float, float], centres: Array, yaws: Array, sizes: Array
) -> Array:
    """[K] float64 metres from a rectangle to others; below 0 the depth by which they overlap.

    Disjoint convex shapes are nearest at a corner of one of them; the depth is the least over the
    directions of their sides (separating axes, Gottschalk et al. 1996).

    Args:
        box: centre x, y [m], yaw [rad], length, width [m]; one without length is a bumper.
        centres: [K, 2 or 3] [m].
        yaws: [K] [rad].
        sizes: [K, 2 or 3] length and width first [m].
    """
    found: Array = np.empty(len(yaws))
    signed_gaps_into(box, centres, yaws, sizes, found)
    return found
