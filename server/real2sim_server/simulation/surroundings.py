"""How far points are from colliders, for many points at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.rotation import Float
from ..physics.colliders import Box, Collider, HeightField, Plane


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
    raise TypeError(f"unknown collider {type(collider).__name__}")


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
