"""Order of points along a Z curve, so that neighbours in a file are neighbours in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....geometry.transform import Float

BITS = 21
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(points: Float) -> NDArray[np.int64]:
    """Indices [N] that sort ``points`` [N, 3] along a Z curve of 2^21 cells a side.

    Cells are cubes over the longest extent of the points. Equal cells keep their order.
    """
    if not len(points):
        return np.empty(0, dtype=np.int64)
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    cells = (points - low) / (extent or 1.0) * (2**BITS - 1)
    x, y, z = (_spread(cells[:, axis].astype(np.uint64)) for axis in range(3))
    return np.argsort(x | y << np.uint64(1) | z << np.uint64(2), kind="stable")


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Two zero bits between any two of the lowest 21 bits."""
    for shift, mask in _SPREAD:
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values
