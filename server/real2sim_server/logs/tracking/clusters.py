"""Clusters of points above the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...geometry.rotation import Float
from ...geometry.transform import apply_transform
from ..driving_log import LidarSweep
from .sweep_ground import find_sweep_ground

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
