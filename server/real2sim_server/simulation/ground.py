"""Road surface from points, LiDAR's or Gaussians', as a collider.

The paper's recipe: boxes are projected down onto the points, points around the projections are
kept, and RANSAC (Fischler and Bolles 1981) finds the plane among them. Roads are no planes, so
the plane is then refined to a field of heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..geometry.rotation import Float
from ..physics.colliders import HeightField, Plane
from ..physics.errors import PhysicsError

REACH = 2.5
"""Points this far around a projected box are looked at [m]."""
UNDER = 1.0
"""And this far below the box's bottom [m]."""
TOLERANCE = 0.08
"""Inliers are this near to the plane [m]."""
ROUNDS = 400
LEAN_MAX = np.cos(np.radians(25))
CELL = 0.5
MARGIN = 15.0
"""Heights reach this far beyond the boxes [m]."""
PASSES = ((0.5, 4.0), (0.25, 2.0), (0.15, 1.0))
"""Refinement: points this near the surface so far [m], then smoothing [cells]."""
LOW_SHARE = 0.4
"""Of a cell's points the one at this share from below counts; things stand on the ground."""


@dataclass(frozen=True, eq=False)
class Road:
    """Ground found among points.

    Attributes:
        plane: through the inliers, normal upwards.
        candidates: [K] indices of the points around the projected boxes.
        inliers: [K] bool, those of them on the plane.
        field: heights around the boxes.
        rms: distance of inliers from the plane, root mean square [m].
    """

    plane: Plane
    candidates: NDArray[np.int64]
    inliers: NDArray[np.bool_]
    field: HeightField
    rms: float


def find_road(
    points: Float,
    boxes: Sequence[tuple[Float, Sequence[float]]],
    *,
    friction: float | None = 0.7,
    seed: int = 0,
) -> Road:
    """The road under boxes.

    Args:
        points: [N, 3] of the background, world [m].
        boxes: (``T_world_box`` [4, 4], (length, width, height)) of what stands on the road.
        friction: of the collider.
        seed: of RANSAC's draws; the same seed gives the same road.

    Raises:
        PhysicsError: no boxes, or fewer than three points around them, or no plane near level.
    """
    if not boxes:
        raise PhysicsError("no boxes to look for ground under; give at least one")
    candidates = np.flatnonzero(_around(points, boxes))
    if len(candidates) < 3:
        raise PhysicsError(
            f"{len(candidates)} of {len(points)} points lie around the {len(boxes)} boxes; "
            "at least 3 are needed to find the ground"
        )
    normal, offset, inliers = _ransac(points[candidates], seed)
    distance = points[candidates[inliers]] @ normal - offset
    plane = Plane(name="ground", point=normal * offset, normal=normal, friction=friction)
    field = _refine(points, boxes, normal, offset, friction)
    return Road(plane, candidates, inliers, field, float(np.sqrt((distance**2).mean())))


def _around(points: Float, boxes: Sequence[tuple[Float, Sequence[float]]]) -> NDArray[np.bool_]:
    """Points near the boxes' projections and below the boxes' middles."""
    near = np.zeros(len(points), dtype=bool)
    for pose, size in boxes:
        half = np.asarray(size, dtype=np.float64) / 2
        reach = float(np.hypot(half[0], half[1])) + REACH
        close = np.flatnonzero((np.abs(points[:, :2] - pose[:2, 3]) < reach).all(axis=1))
        forward = pose[:2, 0] / max(float(np.linalg.norm(pose[:2, 0])), 1e-9)
        offset = points[close, :2] - pose[:2, 3]
        along = np.abs(offset @ forward)
        across = np.abs(offset @ np.array([-forward[1], forward[0]]))
        height = points[close, 2] - (pose[2, 3] - half[2])
        inside = (along < half[0] + REACH) & (across < half[1] + REACH)
        near[close[inside & (height > -UNDER) & (height < half[2])]] = True
    return near


def _ransac(points: Float, seed: int) -> tuple[Float, float, NDArray[np.bool_]]:
    """Unit normal [3] and offset of the plane with most inliers, refitted to them."""
    draw = np.random.default_rng(seed)
    sample = points if len(points) <= 20_000 else points[draw.permutation(len(points))[:20_000]]
    best, most = None, -1
    for _ in range(ROUNDS):
        a, b, c = sample[draw.choice(len(sample), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9 or abs(normal[2]) < LEAN_MAX * length:
            continue
        normal *= np.sign(normal[2]) / length
        count = int((np.abs((sample - a) @ normal) < TOLERANCE).sum())
        if count > most:
            best, most = (normal, float(normal @ a)), count
    if best is None:
        raise PhysicsError("no plane near level among the points around the boxes")
    normal, offset = best
    for _ in range(3):
        own = points[np.abs(points @ normal - offset) < TOLERANCE]
        if len(own) < 3:
            break
        centre = own.mean(axis=0)
        normal = np.linalg.svd(own - centre, full_matrices=False)[2][2]
        normal = normal * np.sign(normal[2])
        offset = float(normal @ centre)
    return normal, offset, np.abs(points @ normal - offset) < TOLERANCE


def _refine(
    points: Float,
    boxes: Sequence[tuple[Float, Sequence[float]]],
    normal: Float,
    offset: float,
    friction: float | None,
) -> HeightField:
    """Heights that start as the plane and follow the points near them, coarse to fine."""
    places = np.array([pose[:2, 3] for pose, _ in boxes])
    low = places.min(axis=0) - MARGIN
    shape = tuple(np.ceil((places.max(axis=0) + MARGIN - low) / CELL).astype(int) + 1)
    grid = np.indices(shape).astype(np.float64) * CELL
    x, y = grid[0] + low[0], grid[1] + low[1]
    heights = (offset - normal[0] * x - normal[1] * y) / normal[2]
    plane = heights
    cell = np.rint((points[:, :2] - low) / CELL).astype(np.int64)
    inside = ((cell >= 0) & (cell < shape)).all(axis=1)
    points, cell = points[inside], cell[inside]
    for tolerance, blur in PASSES:
        own = np.abs(points[:, 2] - heights[tuple(cell.T)]) < tolerance
        measured, weight = _lowest(points[own, 2], cell[own], shape)
        # Far from any point the plane holds; a trace of it keeps the division sound.
        share = ndimage.gaussian_filter(weight, blur, mode="nearest")
        sums = ndimage.gaussian_filter(weight * (measured - plane), blur, mode="nearest")
        heights = plane + sums / (share + 1e-3)
    return HeightField(name="ground", heights=heights, origin=low, spacing=CELL, friction=friction)


def _lowest(heights: Float, cell: NDArray[np.int64], shape: tuple[int, ...]) -> tuple[Float, Float]:
    """A low height of each cell's points, and a weight that is 0 where there are none."""
    flat = cell[:, 0] * shape[1] + cell[:, 1]
    order = np.lexsort((heights, flat))
    cells, starts, counts = np.unique(flat[order], return_index=True, return_counts=True)
    found, weight = np.zeros(shape).ravel(), np.zeros(shape).ravel()
    found[cells] = heights[order][starts + (counts * LOW_SHARE).astype(np.int64)]
    weight[cells] = np.minimum(counts / 3, 1.0)
    return found.reshape(shape), weight.reshape(shape)


__all__ = ["Road", "find_road"]
