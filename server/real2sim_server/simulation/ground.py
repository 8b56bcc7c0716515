"""The scene's ground as a collider."""

from __future__ import annotations

import numpy as np

from ..geometry.rotation import Float
from ..physics.colliders import HeightField
from ..scene import Ground

GROUND = "ground"
"""Name of the collider; tyres roll on what has it."""

MARGIN = 40.0
"""The collider reaches this far around what it is for [m]."""


def ground_collider(
    ground: Ground, places: Float, *, offset: float = 0.0, friction: float | None = None
) -> HeightField:
    """The cells of a scene's ground around some places: the same surface, bit for bit.

    Args:
        ground: of the scene.
        places: [N, 2] what the collider is for, N >= 1, world [m].
        offset: by which it is raised [m].
        friction: of the collider; None for that of the bodies.
    """
    last = np.array(ground.heights.shape) - 1
    low, high = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    first = np.floor((low - ground.first_centre) / ground.cell).astype(np.int64)
    end = np.ceil((high - ground.first_centre) / ground.cell).astype(np.int64)
    # At least two samples each way, also where the places are beside the grid.
    i, j = np.clip(first, 0, last - 1).tolist()
    m, n = np.clip(end, [i + 1, j + 1], last).tolist()
    return HeightField(
        name=GROUND,
        heights=ground.heights[i : m + 1, j : n + 1].astype(np.float64) + offset,
        origin=ground.first_centre + np.array([i, j]) * ground.cell,
        spacing=ground.cell,
        friction=friction,
    )
