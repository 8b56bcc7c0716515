"""Points spread over the road and the pavement, where Gaussians are laid.

LiDAR rings leave gaps on the road, and nothing is ever measured under a parked car. The fitted
ground closes both, so that the road is whole when a car is taken away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...scene import Ground
from ...scene.ground_fit import GroundFit


@dataclass(frozen=True, eq=False)
class GroundPoints:
    """Points spread evenly over the ground.

    Attributes:
        points: [N, 3] float32, world [m].
        normals: [N, 3] float32, unit, upwards.
        spacing: [N] float32, distance to the next point [m].
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    spacing: NDArray[np.float32]


def spread_ground(fit: GroundFit, spacing: float, limit: int) -> GroundPoints:
    """Cover the ground with a square grid that coarsens with the distance from the drive.

    Args:
        fit: of the ground; points lie on its surface as it was measured.
        spacing: distance between points near the drive [m].
        limit: at most so many points; the grid is as much coarser as that takes.
    """
    while True:
        parts = [
            _grid_ring(fit, spacing * factor, inner, outer)
            for factor, inner, outer in ((1, 0, 12), (2, 12, 24), (4, 24, 45), (8, 45, 1e9))
        ]
        if sum(len(p) for p in parts) <= limit:
            break
        spacing *= 1.15
    xy = np.concatenate(parts)
    step = np.concatenate(
        [np.full(len(p), spacing * f) for p, f in zip(parts, (1, 2, 4, 8), strict=True)]
    )
    z = fit.surface.height_at(xy)
    return GroundPoints(
        np.concatenate([xy, z[:, None]], axis=1).astype(np.float32),
        _surface_normals(fit.surface, xy),
        step.astype(np.float32),
    )


def _grid_ring(fit: GroundFit, step: float, inner: float, outer: float) -> Float:
    """Grid points [N, 2] on ground cells between two distances from the drive."""
    surface = fit.surface
    wanted = surface.is_ground & (fit.distance >= inner) & (fit.distance < outer)
    rows, columns = np.nonzero(wanted)
    if len(rows) == 0:
        return np.zeros((0, 2))
    corner = surface.origin + np.stack([rows, columns], axis=1) * surface.cell
    first = np.ceil(corner / step - 0.5).astype(np.int64)
    count = int(np.ceil(surface.cell / step)) + 1
    offsets = np.stack(np.meshgrid(np.arange(count), np.arange(count), indexing="ij"), -1)
    xy = (first[:, None] + offsets.reshape(1, -1, 2) + 0.5) * step
    inside = ((xy >= corner[:, None]) & (xy < corner[:, None] + surface.cell)).all(axis=-1)
    return np.asarray(xy[inside])


def _surface_normals(surface: Ground, xy: Float) -> NDArray[np.float32]:
    step = surface.cell
    x_step, y_step = np.array([step, 0.0]), np.array([0.0, step])
    along_x = surface.height_at(xy + x_step) - surface.height_at(xy - x_step)
    along_y = surface.height_at(xy + y_step) - surface.height_at(xy - y_step)
    normals = np.stack([-along_x, -along_y, np.full(len(xy), 2 * step)], axis=1)
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(unit, dtype=np.float32)
