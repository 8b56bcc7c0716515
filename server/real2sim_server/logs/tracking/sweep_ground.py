"""The ground in one sweep, in the frame of the vehicle that saw it.

This is no second ground of a scene: tracking runs before there is one, on single sweeps, and needs
only to know which points stand up. A scene's ground is :class:`~real2sim_server.scene.Ground`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...geometry.rotation import Float

CELL = 1.0
WINDOW = 7
"""Cells; wider than any vehicle, so that no roof is taken for the road."""

LOWEST = 10.0
"""Percentile of heights in a cell that counts as its lowest point; below it is noise."""


@dataclass(frozen=True, eq=False)
class SweepGround:
    """Heights of the ground on a grid around the vehicle.

    Attributes:
        heights: [N, N] z [m] in the vehicle frame, cell by cell of size CELL.
        reach: half the side of the grid [m].
    """

    heights: Float
    reach: float

    def at(self, places: Float) -> Float:
        """Height of the ground [m] below places [..., >= 2], bilinear between cells."""
        cells = (places[..., :2] + self.reach) / CELL - 0.5
        rows, columns = cells[..., 0].ravel(), cells[..., 1].ravel()
        found = ndimage.map_coordinates(self.heights, [rows, columns], order=1, mode="nearest")
        return np.asarray(found).reshape(places.shape[:-1])


def find_sweep_ground(points: Float, reach: float) -> SweepGround:
    """The ground under points [N, 3] in the vehicle frame, within ``reach`` [m].

    The lowest points of each cell, opened (a minimum, then a maximum over a window), which takes
    away whatever is narrower than the window and stands out, then smoothed.
    """
    side = int(np.ceil(2 * reach / CELL))
    cells = np.floor((points[:, :2] + reach) / CELL).astype(int)
    inside = ((cells >= 0) & (cells < side)).all(axis=1)
    index = cells[inside, 0] * side + cells[inside, 1]
    lowest = _lowest(points[inside, 2], index, side * side).reshape(side, side)
    filled = _fill(lowest)
    opened = ndimage.grey_opening(filled, size=(WINDOW, WINDOW), mode="nearest")
    return SweepGround(ndimage.uniform_filter(opened, 3, mode="nearest"), side * CELL / 2)


def _lowest(heights: Float, index: NDArray[np.intp], cells: int) -> Float:
    order = np.lexsort((heights, index))
    index, heights = index[order], heights[order]
    used, starts, counts = np.unique(index, return_index=True, return_counts=True)
    lowest = np.full(cells, np.nan)
    lowest[used] = heights[starts + (counts * LOWEST / 100).astype(int)]
    return lowest


def _fill(heights: Float) -> Float:
    """Empty cells get the height of the nearest one that is not."""
    empty = np.isnan(heights)
    if empty.all():
        return np.zeros_like(heights)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])
