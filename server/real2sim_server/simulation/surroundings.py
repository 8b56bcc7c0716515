"""How far points are from colliders, for many points at once."""

# Kernels take arrays by position, and Numba knows no keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from .._numba import kernel
from ..geometry.rotation import Float
from ..physics.colliders import Box, Collider, HeightField, Plane, Solid
from ..physics.contact import collider_distance, collider_velocity
from ..physics.model import pack_colliders
from .rigid import RigidMotion


@functools.lru_cache(maxsize=64)
def packed(colliders: tuple[Collider, ...]) -> tuple[Float, Float]:
    """Rows and heights of colliders as kernels read them, kept while the colliders are the same."""
    return pack_colliders(colliders, 0.0)


def closest(
    points: Float,
    motion: RigidMotion,
    colliders: Sequence[Collider],
    *,
    within: float,
    ahead: float,
) -> tuple[float, float, bool]:
    """How near points of a rigid body are to colliders that may move.

    Args:
        points: [N, 3] of the body, world [m].
        motion: of the body.
        colliders: as they are now.
        within: [m].
        ahead: [s].

    Returns:
        Least distance [m], infinite from none; the speed at which that point and the collider
        approach each other [m/s]; and whether any point that approaches a collider will be
        ``within`` of it in the time ``ahead``.
    """
    if not colliders:
        return math.inf, 0.0, False
    rows, heights = packed(tuple(colliders))
    found: tuple[float, float, bool] = _closest(
        points,
        motion.centre,
        motion.velocity,
        motion.angular_velocity,
        rows,
        heights,
        within,
        ahead,
    )
    return found


@kernel
def _closest(
    points: Any, centre: Any, velocity: Any, spin: Any, rows: Any, heights: Any, within: Any,
    ahead: Any,
) -> Any:  # fmt: skip
    least, closing, meets = math.inf, 0.0, False
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        ax, ay, az = x - centre[0], y - centre[1], z - centre[2]
        vx = velocity[0] + spin[1] * az - spin[2] * ay
        vy = velocity[1] + spin[2] * ax - spin[0] * az
        vz = velocity[2] + spin[0] * ay - spin[1] * ax
        for c in range(len(rows)):
            distance, n = collider_distance(rows[c], heights, x, y, z)
            u = collider_velocity(rows[c], x, y, z)
            approach = (u[0] - vx) * n[0] + (u[1] - vy) * n[1] + (u[2] - vz) * n[2]
            if distance < least:
                least, closing = distance, approach
            if approach > 0.0 and distance < within + approach * ahead:
                meets = True
    return least, closing, meets


def solid_gaps(pose: Float, size: Float, solids: Sequence[Solid]) -> tuple[Float, Float]:
    """How far solids are at least from an oriented box, and how fast they are at most.

    Args:
        pose: [4, 4] of the one box.
        size: [3] of it [m].
        solids: K of them.

    Returns:
        [K] lower bounds of the distance, along the faces of the boxes about these; below 0 where
        they may overlap [m]; and [K] speeds that no point of them exceeds [m/s].
    """
    centres, turns, halves, speeds = _boxes_about(tuple(solids))
    between = np.abs((turns @ (pose[:3, 3] - centres)[:, :, None])[:, :, 0])
    reach = np.abs(turns @ pose[:3, :3]) @ (size / 2)
    gaps: Float = (between - halves - reach).max(axis=1)
    return gaps, speeds


@functools.lru_cache(maxsize=64)
def _boxes_about(solids: tuple[Solid, ...]) -> tuple[Float, Float, Float, Float]:
    """Centres [K, 3], rotations box from world [K, 3, 3], halves of sizes [K, 3], speeds [K]."""
    poses = np.array([s.pose for s in solids])
    bounds = np.array([s.bounds for s in solids])
    speeds = np.array([s.fastest_point for s in solids])
    halves = (bounds[:, 1] - bounds[:, 0]) / 2
    middles = (bounds[:, 0] + bounds[:, 1]) / 2
    centres = poses[:, :3, 3] + (poses[:, :3, :3] @ middles[:, :, None])[:, :, 0]
    return centres, poses[:, :3, :3].transpose(0, 2, 1), halves, speeds


def clearance(collider: Collider, points: Float) -> tuple[Float, Float]:
    """Signed distances [N] [m] of points [N, 3] to a collider, and unit normals [N, 3] out of it.

    A height field measures along the normal under the point, as the solver does.
    """
    if isinstance(collider, Plane):
        normal = np.asarray(collider.normal)
        return (points - np.asarray(collider.point)) @ normal, np.tile(normal, (len(points), 1))
    if isinstance(collider, Box):
        return _box(collider, points)
    if isinstance(collider, HeightField):
        return _heights(collider, points)
    if isinstance(collider, Solid):
        rows, data = packed((collider,))
        distances, normals = np.empty(len(points)), np.empty((len(points), 3))
        _clearances(rows[0], data, np.ascontiguousarray(points), distances, normals)
        return distances, normals
    raise TypeError(f"unknown collider {type(collider).__name__}")


@kernel
def _clearances(row: Any, data: Any, points: Any, distances: Any, normals: Any) -> None:
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        distance, n = collider_distance(row, data, x, y, z)
        distances[k] = distance
        normals[k, 0], normals[k, 1], normals[k, 2] = n


def nearest(colliders: Sequence[Collider], points: Float) -> tuple[Float, Float]:
    """The same for the nearest of several colliders; infinitely far from none."""
    best = np.full(len(points), np.inf)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    for collider in colliders:
        distance, normal = clearance(collider, points)
        nearer = distance < best
        best = np.where(nearer, distance, best)
        normals = np.where(nearer[:, None], normal, normals)
    return best, normals


def _box(box: Box, points: Float) -> tuple[Float, Float]:
    pose = np.asarray(box.T_world_box)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    over = np.abs(local) - np.asarray(box.size) / 2
    outside = np.maximum(over, 0)
    length = np.linalg.norm(outside, axis=1)
    deepest = over.argmax(axis=1)
    face = np.eye(3)[deepest]
    normal = np.where(length[:, None] > 0, outside / np.maximum(length, 1e-12)[:, None], face)
    normal = normal * np.where(local < 0, -1.0, 1.0)
    return np.where(length > 0, length, over.max(axis=1)), normal @ pose[:3, :3].T


def _heights(field: HeightField, points: Float) -> tuple[Float, Float]:
    h = field.heights
    last = np.array(h.shape) - 1
    place = (points[:, :2] - np.asarray(field.origin)) / field.spacing
    place = np.clip(place, 0, last)
    low = np.minimum(place.astype(np.int64), last - 1)
    a, b = (place - low).T
    i, j = low.T
    slope_x = ((h[i + 1, j] - h[i, j]) * (1 - b) + (h[i + 1, j + 1] - h[i, j + 1]) * b) / (
        field.spacing
    )
    slope_y = ((h[i, j + 1] - h[i, j]) * (1 - a) + (h[i + 1, j + 1] - h[i + 1, j]) * a) / (
        field.spacing
    )
    height = (h[i, j] * (1 - a) + h[i + 1, j] * a) * (1 - b)
    height += (h[i, j + 1] * (1 - a) + h[i + 1, j + 1] * a) * b
    up = 1 / np.sqrt(slope_x**2 + slope_y**2 + 1)
    normals = np.stack([-slope_x * up, -slope_y * up, up], axis=1)
    return (points[:, 2] - height) * up, normals
