"""Clusters of points above the ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ...geometry.transform import Float, apply_transform
from ..driving_log import LidarSweep

# --- Ground of a sweep ---------------------------------------------------------------------------

# Tracking runs before a scene has a ground, on single sweeps in the frame of the vehicle, and
# only needs to know which points stand up. A scene's ground is `real2sim_server.scene.Ground`.

GROUND_CELL = 1.0
WINDOW = 7
"""Cells; wider than any vehicle, so that no roof is taken for the road."""

LOWEST = 10.0
"""Percentile of heights in a cell that counts as its lowest point; below it is noise."""


@dataclass(frozen=True, eq=False)
class SweepGround:
    """Heights of the ground on a grid around the vehicle.

    Attributes:
        heights: [N, N] z [m] in the vehicle frame, cell by cell of size GROUND_CELL.
        reach: half the side of the grid [m].
    """

    heights: Float
    reach: float

    def at(self, places: Float) -> Float:
        """Height of the ground [m] below places [..., >= 2], bilinear between cells."""
        cells = (places[..., :2] + self.reach) / GROUND_CELL - 0.5
        rows, columns = cells[..., 0].ravel(), cells[..., 1].ravel()
        found = ndimage.map_coordinates(self.heights, [rows, columns], order=1, mode="nearest")
        return np.asarray(found).reshape(places.shape[:-1])


def find_sweep_ground(points: Float, reach: float) -> SweepGround:
    """The ground under points [N, 3] in the vehicle frame, within ``reach`` [m].

    The lowest points of each cell, opened (a minimum, then a maximum over a window), which takes
    away whatever is narrower than the window and stands out, then smoothed.
    """
    side = int(np.ceil(2 * reach / GROUND_CELL))
    cells = np.floor((points[:, :2] + reach) / GROUND_CELL).astype(int)
    inside = ((cells >= 0) & (cells < side)).all(axis=1)
    index = cells[inside, 0] * side + cells[inside, 1]
    lowest = _lowest(points[inside, 2], index, side * side).reshape(side, side)
    filled = _fill(lowest)
    opened = ndimage.grey_opening(filled, size=(WINDOW, WINDOW), mode="nearest")
    return SweepGround(ndimage.uniform_filter(opened, 3, mode="nearest"), side * GROUND_CELL / 2)


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


CELL = 0.35
HEIGHTS = (0.25, 4.2)
"""Only points this far above the ground [m] count: neither kerbs nor bridges."""

EGO_MARGIN = 0.6
MIN_POINTS = 6
MAX_EXTENT = 20.0
MAX_BOTTOM = 1.2
MIN_TOP = 0.5


@dataclass(frozen=True, eq=False)
class LidarCluster:
    """Points of one object in one sweep.

    Attributes:
        points: [N, 3] world [m].
        offset: [N] when each was measured, relative to the frame [s].
        centre: [2] middle of the points' extent in the world [m].
        ground: height of the ground below, world z [m].
        sensor: [3] where the LiDAR was, world [m].
    """

    points: Float
    offset: Float
    centre: Float
    ground: float
    sensor: Float


def find_clusters(
    sweep: LidarSweep,
    T_world_vehicle: Float,
    *,
    reach: float,
    ego_size: tuple[float, float, float],
) -> list[LidarCluster]:
    """Objects on the ground within ``reach`` [m] of the vehicle.

    Points in the same or in neighbouring cells of a grid seen from above belong together; what is
    too long, too few points, too flat or too far above the ground for something that drives or
    walks is left out.
    """
    points = sweep.points.astype(np.float64)
    near = (np.abs(points[:, :2]) < reach).all(axis=1) & ~_on_ego(points, ego_size)
    points, offset = points[near], sweep.offset_us[near].astype(np.float64) * 1e-6
    ground = find_sweep_ground(points, reach)
    below = ground.at(points)
    above = points[:, 2] - below
    standing = (above > HEIGHTS[0]) & (above < HEIGHTS[1])
    points, offset, below = points[standing], offset[standing], below[standing]
    sensor = apply_transform(T_world_vehicle, sweep.origin.astype(np.float64)[None])[0]
    world = apply_transform(T_world_vehicle, points)
    lift = world[:, 2] - points[:, 2]
    clusters: list[LidarCluster] = []
    for members in _groups(points, reach):
        bottom, top = np.percentile(points[members, 2] - below[members], [2, 98])
        extent = np.ptp(points[members, :2], axis=0)
        if np.hypot(*extent) > MAX_EXTENT or bottom > MAX_BOTTOM or top < MIN_TOP:
            continue
        low, high = world[members, :2].min(axis=0), world[members, :2].max(axis=0)
        clusters.append(
            LidarCluster(
                points=world[members],
                offset=offset[members],
                centre=(low + high) / 2,
                ground=float(np.median(below[members] + lift[members])),
                sensor=sensor,
            )
        )
    return clusters


def _on_ego(points: Float, size: tuple[float, float, float]) -> NDArray[np.bool_]:
    """Points on the recording vehicle itself; its rear axle is at the origin."""
    length, width, _ = size
    along = (points[:, 0] > -0.35 * length - EGO_MARGIN) & (points[:, 0] < 0.85 * length)
    return np.asarray(along & (np.abs(points[:, 1]) < width / 2 + EGO_MARGIN / 2))


def _groups(points: Float, reach: float) -> list[NDArray[np.intp]]:
    """Indices of the points of every group of at least FEWEST_POINTS."""
    if not len(points):
        return []
    cells = np.floor((points[:, :2] + reach) / CELL).astype(int)
    side = int(np.ceil(2 * reach / CELL)) + 1
    occupied = np.zeros((side, side), dtype=bool)
    occupied[cells[:, 0], cells[:, 1]] = True
    labels, _ = ndimage.label(occupied, np.ones((3, 3), int))
    mine = labels[cells[:, 0], cells[:, 1]]
    order = np.argsort(mine, kind="stable")
    _, starts = np.unique(mine[order], return_index=True)
    groups = np.split(order, starts[1:])
    return [g for g in groups if len(g) >= MIN_POINTS]


# --- Free space ----------------------------------------------------------------------------------

# Distinguishes free space from what is merely occluded.

BEAM = 0.013
"""A beam observes directions this near to its own [rad]."""

NEIGHBOURS = 4
SAME_RANGE = 0.4
"""A beam that ends this near to a point hit the same surface [m]."""

MIN_RANGE = 1.0


@dataclass(frozen=True, eq=False)
class SweepRays:
    """Rays of one sweep: from ``sensor`` [3] to ``points`` [N, 3], world [m]."""

    points: NDArray[np.float32]
    sensor: Float

    @cached_property
    def _beams(self) -> tuple[cKDTree, Float]:
        """Directions as a tree, and ranges; built when it is needed first."""
        rays = self.points - self.sensor
        ranges = np.linalg.norm(rays, axis=1)
        seen = ranges > MIN_RANGE
        return cKDTree(rays[seen] / ranges[seen, None]), ranges[seen]

    def count(self, points: Float) -> tuple[int, int]:
        """How many of points [N, 3] in the world are observed free, and how many occupied.

        A beam that passes a point observes free space there, one that ends at the point observes
        it occupied, and one that ends before it observes nothing.
        """
        tree, ranges = self._beams
        rays = points - self.sensor
        distance = np.linalg.norm(rays, axis=1)
        near = distance > MIN_RANGE
        if not near.any() or len(ranges) < NEIGHBOURS:
            return 0, 0
        rays, distance = rays[near] / distance[near, None], distance[near]
        apart, index = tree.query(rays, k=NEIGHBOURS, distance_upper_bound=BEAM)
        known = np.isfinite(apart)
        found = np.where(known, ranges[np.minimum(index, len(ranges) - 1)], np.nan)
        beyond = found - distance[:, None]
        occupied = (np.abs(beyond) < SAME_RANGE).any(axis=1)
        # NaN compares false: what no beam observes is neither.
        passed = (beyond > SAME_RANGE).sum(axis=1)
        free = ~occupied & (passed > 0) & (passed == known.sum(axis=1))
        return int(free.sum()), int(occupied.sum())
