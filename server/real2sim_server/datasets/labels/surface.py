"""Which pixels of an object show its surface, and not the shadow that belongs to it.

A reconstructed object holds the dark ground below it too, which moves with it. Those pixels are the
ground's: where they are is told by the object's box.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...geometry.transform import apply_transform, invert_transform

MARGIN = 0.2
"""Surface may lie so far outside of the box [m]: boxes are as exact as who drew them."""

CLEARANCE = 0.12
"""What is less above the box's lowest face, below it too, is the ground [m]."""


def on_surface(
    points: NDArray[np.float32], T_world_object: Float, size: Sequence[float]
) -> NDArray[np.bool_]:
    """Which points [N, 3] of the world at an object's pixels are of itself, [N] bool."""
    local = apply_transform(invert_transform(T_world_object), points)
    half = np.asarray(size) / 2
    inside = (np.abs(local[:, :2]) <= half[:2] + MARGIN).all(axis=1)
    upper: NDArray[np.bool_] = local[:, 2] <= half[2] + MARGIN
    return inside & upper & (local[:, 2] >= _lowest(half[2]))


def _lowest(half_height: float) -> float:
    """Lowest surface of an object in its own frame; flat things are all surface."""
    return -half_height + min(CLEARANCE, half_height / 4)
