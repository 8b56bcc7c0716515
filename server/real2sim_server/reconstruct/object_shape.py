"""Shape of objects where LiDAR says too little."""

from __future__ import annotations

import numpy as np

from .points import PointSet


def add_box_surface(
    measured: PointSet, size: tuple[float, float, float], *, spacing: float = 0.1
) -> PointSet:
    """Measured points together with points on the sides and the top of the box.

    An object that was hardly seen still has a body that can be moved, hit and drawn.

    Args:
        measured: points in the object frame.
        size: (length, width, height) [m].
        spacing: distance between surface points [m].
    """
    # Bodies are a little smaller than their boxes.
    half = 0.95 * np.array(size) / 2
    faces = [_face(half, axis, sign, spacing) for axis in (0, 1) for sign in (-1, 1)]
    faces.append(_face(half, 2, 1, spacing))
    surface = np.concatenate(faces)
    typical = float(measured.intensity.mean()) if len(measured) else 0.3
    added = PointSet.measured(surface, np.full(len(surface), typical, dtype=np.float32))
    return PointSet.join([measured, added])


def _face(half: np.ndarray, axis: int, sign: int, spacing: float) -> np.ndarray:
    others = [a for a in range(3) if a != axis]
    counts = [max(2, int(np.ceil(2 * half[a] / spacing))) for a in others]
    grids = np.meshgrid(
        *(((np.arange(n) + 0.5) / n * 2 - 1) * half[a] for n, a in zip(counts, others, strict=True))
    )
    points = np.zeros((grids[0].size, 3))
    points[:, axis] = sign * half[axis]
    for a, grid in zip(others, grids, strict=True):
        points[:, a] = grid.ravel()
    return points
