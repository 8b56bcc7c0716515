"""The road and the pavement: a height grid fitted to the background, and points spread on it.

LiDAR rings leave gaps on the road, and nothing is ever measured under a parked car. A surface
closes both, so that the road is whole when a car is taken away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...geometry.transform import apply_transform
from ...logs import ObjectTrack
from .pull_push import pull_push

REACH = 70.0
"""The surface is fitted this far around the drive [m]."""
LEVELS = ((4.0, 0.6, 0.03), (1.0, 0.35, 0.0), (0.25, 0.15, 0.0))
"""Coarse to fine: cell [m], tolerance to the level before [m], its growth with distance."""
CLOSING = ((25.0, 1.5), (REACH, 4.0))
"""Up to this distance from the drive, gaps of up to twice this many metres are closed."""


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """Heights on a grid in the world.

    Attributes:
        origin: [2] float64, corner of cell (0, 0) [m].
        cell: edge of a cell [m].
        heights: [X, Y] float32, z at cell centres [m], filled everywhere.
        is_ground: [X, Y] bool, cells that are road, pavement or other ground.
        distance: [X, Y] float32, from the drive [m].
    """

    origin: Float
    cell: float
    heights: NDArray[np.float32]
    is_ground: NDArray[np.bool_]
    distance: NDArray[np.float32]

    def height_at(self, xy: Float) -> NDArray[np.float32]:
        """Bilinear z [N] [m] at ``xy`` [N, 2]; at the border the nearest cell counts."""
        place = np.clip(
            (xy - self.origin) / self.cell - 0.5, 0, np.array(self.heights.shape) - 1.000001
        )
        low = place.astype(np.int64)
        high = np.minimum(low + 1, np.array(self.heights.shape) - 1)
        f = (place - low).astype(np.float32)
        h = self.heights
        near = h[low[:, 0], low[:, 1]] * (1 - f[:, 1]) + h[low[:, 0], high[:, 1]] * f[:, 1]
        far = h[high[:, 0], low[:, 1]] * (1 - f[:, 1]) + h[high[:, 0], high[:, 1]] * f[:, 1]
        return near * (1 - f[:, 0]) + far * f[:, 0]

    def covers(self, xy: Float) -> NDArray[np.bool_]:
        """Whether ``xy`` [N, 2] lies on ground, [N] bool."""
        index = np.floor((xy - self.origin) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.heights.shape)).all(axis=1)
        index = np.clip(index, 0, np.array(self.heights.shape) - 1)
        return inside & self.is_ground[index[:, 0], index[:, 1]]


def fit_ground(points: Float, T_world_vehicle: Float, boxes: BoxBottoms) -> GroundSurface:
    """Fit the ground, coarse to fine, starting from where the vehicle drove.

    On each level a cell takes a low quantile of those of its points that agree with the level
    before. Cells without any take the bottom of a box that stood there, or are filled from their
    neighbours.

    Args:
        points: [N, 3], background in the world [m].
        T_world_vehicle: [P, 4, 4] poses of the vehicle, whose origin moves on the ground.
        boxes: what stands on the ground and hides it.
    """
    path = T_world_vehicle[:, :2, 3]
    coarsest = LEVELS[0][0]
    low = np.floor((path.min(axis=0) - REACH) / coarsest) * coarsest
    size = np.ceil((path.max(axis=0) + REACH - low) / coarsest).astype(int) * coarsest
    points, bottoms = (_within(p, low, size) for p in (points, boxes.points))
    surface = None
    for cell, tolerance, growth in LEVELS:
        agreeing = [
            p[_agrees(p, surface, T_world_vehicle, tolerance, growth)] for p in (points, bottoms)
        ]
        surface = _fit_level(*agreeing, _Grid(low, size, cell), path)
    assert surface is not None
    return _close(surface, boxes.footprints)


def _within(points: Float, low: Float, size: Float) -> Float:
    inside = ((points[:, :2] >= low) & (points[:, :2] < low + size)).all(axis=1)
    return points[inside].astype(np.float64)


def _agrees(
    points: Float,
    surface: GroundSurface | None,
    T_world_vehicle: Float,
    tolerance: float,
    growth: float,
) -> NDArray[np.bool_]:
    """Which points [N] lie near the surface of the level before, or near the driven plane."""
    if surface is not None:
        expected = surface.height_at(points[:, :2])
        return np.abs(points[:, 2] - expected) < tolerance
    distance, expected = _driven_plane(points, T_world_vehicle)
    return np.abs(points[:, 2] - expected) < tolerance + growth * distance


def _driven_plane(points: Float, T_world_vehicle: Float) -> tuple[Float, Float]:
    """Distance [N] from the drive, and z [N] on the nearest vehicle's own ground plane."""
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(T_world_vehicle[:, :2, 3]).query(points[:, :2], workers=-1)
    pose = T_world_vehicle[nearest]
    normal, origin = pose[:, :3, 2], pose[:, :3, 3]
    offset = ((points[:, :2] - origin[:, :2]) * normal[:, :2]).sum(axis=1)
    return distance, origin[:, 2] - offset / normal[:, 2]


@dataclass(frozen=True, eq=False)
class _Grid:
    low: Float
    size: Float
    cell: float

    @property
    def shape(self) -> tuple[int, int]:
        x, y = np.round(self.size / self.cell).astype(int)
        return int(x), int(y)

    def cells(self, xy: Float) -> NDArray[np.int64]:
        index = np.floor((xy - self.low) / self.cell).astype(np.int64)
        return index[:, 0] * self.shape[1] + index[:, 1]


def _fit_level(points: Float, bottoms: Float, grid: _Grid, path: Float) -> GroundSurface:
    shape = grid.shape
    heights = np.zeros(shape[0] * shape[1], dtype=np.float32)
    weights = np.zeros(len(heights), dtype=np.float32)
    under = grid.cells(bottoms[:, :2])
    heights[under] = bottoms[:, 2]
    weights[under] = 1
    cell = grid.cells(points[:, :2])
    order = np.lexsort((points[:, 2], cell))
    cells, starts, sizes = np.unique(cell[order], return_index=True, return_counts=True)
    # Low, because what stands on the ground is never below it; not lowest, because of noise.
    heights[cells] = points[order][starts + (sizes * 0.35).astype(np.int64), 2]
    weights[cells] = np.minimum(sizes / 3, 1)
    filled = pull_push(heights.reshape(*shape, 1), weights.reshape(shape))[..., 0]
    centres = grid.low + (np.indices(shape).reshape(2, -1).T + 0.5) * grid.cell
    distance = _path_distance(centres, path).reshape(shape)
    measured = np.zeros(len(heights), dtype=np.bool_)
    measured[cells] = True
    return GroundSurface(grid.low, grid.cell, filled, measured.reshape(shape), distance)


def _path_distance(xy: Float, path: Float) -> NDArray[np.float32]:
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(path).query(xy, workers=-1)
    return np.asarray(distance, dtype=np.float32)


def _close(surface: GroundSurface, footprints: Float) -> GroundSurface:
    """Add gaps between rings, what boxes hide, and what is under the vehicle itself."""
    import cv2

    measured = surface.is_ground.astype(np.uint8)
    ground = measured.copy()
    inner = 0.0
    for reach, radius in CLOSING:
        cells = round(radius / surface.cell)
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cells + 1, 2 * cells + 1))
        closed = cv2.morphologyEx(measured, cv2.MORPH_CLOSE, disk)
        ring = (surface.distance >= inner) & (surface.distance < reach)
        ground |= np.where(ring, closed, 0).astype(np.uint8)
        inner = reach
    for corners in footprints:
        # fillConvexPoly wants (column, row); the grid is [x, y].
        polygon = np.round((corners - surface.origin) / surface.cell - 0.5)[:, ::-1]
        cv2.fillConvexPoly(ground, polygon.astype(np.int32), 1)
    ground[surface.distance < 3.0] = 1
    ground = cv2.morphologyEx(ground, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    heights = cv2.GaussianBlur(surface.heights, (5, 5), 1.0)
    return GroundSurface(
        surface.origin, surface.cell, heights, ground.astype(bool), surface.distance
    )


@dataclass(frozen=True, eq=False)
class BoxBottoms:
    """Where tracked boxes stand on the ground, over all times.

    Attributes:
        points: [N, 3] float64, spread over the bottoms, world [m].
        footprints: [M, 4, 2] float64, corners of the bottoms, enlarged [m].
    """

    points: Float
    footprints: Float


def box_bottoms(
    tracks: tuple[ObjectTrack, ...], times_us: NDArray[np.int64], *, margin: float = 0.4
) -> BoxBottoms:
    """Bottoms of all boxes at all times at which they exist."""
    points, footprints = [np.zeros((0, 3))], [np.zeros((0, 4, 2))]
    for track in tracks:
        times = [int(t) for t in times_us if track.trajectory.covers(int(t))]
        for pose in (track.trajectory.transform(t) for t in times):
            points.append(apply_transform(pose, _bottom_grid(track.size)))
            corners = _bottom_corners(track.size, margin)
            footprints.append(apply_transform(pose, corners)[None, :, :2])
    return BoxBottoms(np.concatenate(points), np.concatenate(footprints))


def _bottom_corners(size: tuple[float, float, float], margin: float) -> Float:
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    corners = np.zeros((4, 3))
    corners[:, :2] = signs * (np.array(size[:2]) / 2 + margin)
    return corners


def _bottom_grid(size: tuple[float, float, float]) -> Float:
    step = LEVELS[-1][0]
    x, y = (np.arange(-s / 2 + step / 2, s / 2, step) for s in size[:2])
    grid = np.stack([g.ravel() for g in np.meshgrid(x, y, indexing="ij")], axis=1)
    return np.concatenate([grid, np.full((len(grid), 1), -size[2] / 2)], axis=1)


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


def spread_ground(surface: GroundSurface, spacing: float, limit: int) -> GroundPoints:
    """Cover the ground with a square grid that coarsens with the distance from the drive.

    Args:
        surface: the ground.
        spacing: distance between points near the drive [m].
        limit: at most so many points; the grid is as much coarser as that takes.
    """
    while True:
        parts = [
            _grid_ring(surface, spacing * factor, inner, outer)
            for factor, inner, outer in ((1, 0, 12), (2, 12, 24), (4, 24, 45), (8, 45, 1e9))
        ]
        if sum(len(p) for p in parts) <= limit:
            break
        spacing *= 1.15
    xy = np.concatenate(parts)
    step = np.concatenate(
        [np.full(len(p), spacing * f) for p, f in zip(parts, (1, 2, 4, 8), strict=True)]
    )
    z = surface.height_at(xy)
    return GroundPoints(
        np.concatenate([xy, z[:, None]], axis=1).astype(np.float32),
        _surface_normals(surface, xy),
        step.astype(np.float32),
    )


def _grid_ring(surface: GroundSurface, step: float, inner: float, outer: float) -> Float:
    """Grid points [N, 2] on ground cells between two distances from the drive."""
    wanted = surface.is_ground & (surface.distance >= inner) & (surface.distance < outer)
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


def _surface_normals(surface: GroundSurface, xy: Float) -> NDArray[np.float32]:
    step = surface.cell
    x_step, y_step = np.array([step, 0.0]), np.array([0.0, step])
    along_x = surface.height_at(xy + x_step) - surface.height_at(xy - x_step)
    along_y = surface.height_at(xy + y_step) - surface.height_at(xy - y_step)
    normals = np.stack([-along_x, -along_y, np.full(len(xy), 2 * step)], axis=1)
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
