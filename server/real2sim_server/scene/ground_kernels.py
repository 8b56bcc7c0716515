"""Heights and poses on a grid of ground heights, compiled: one vehicle asks at every step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._numba import func, kernel

HALF_WHEELBASE, HALF_TRACK = 1.0, 0.8
"""How far ahead, behind and aside of a place its slope is taken [m]: a wheel apart, so that
neither the noise of single cells nor the edge of one decides how a vehicle leans."""


@func
def height_under(heights: Any, frame: Any, x: float, y: float) -> float:
    """Bilinear height between cell centres; outside the nearest place of the rim counts.

    Args:
        heights: [X, Y] float32, at cell centres [m].
        frame: [3] float64, x and y of the centre of cell (0, 0), and the edge of a cell [m].
        x, y: the place [m].
    """
    x0, y0, cell = frame[0], frame[1], frame[2]
    rows, columns = heights.shape
    u = min(max((x - x0) / cell, 0.0), rows - 1.0)
    v = min(max((y - y0) / cell, 0.0), columns - 1.0)
    i, j = min(int(u), rows - 2), min(int(v), columns - 2)
    a, b = u - i, v - j
    low = heights[i, j] * (1.0 - a) + heights[i + 1, j] * a
    high = heights[i, j + 1] * (1.0 - a) + heights[i + 1, j + 1] * a
    return low * (1.0 - b) + high * b


@kernel
def height_at(heights: Any, frame: Any, x: float, y: float) -> float:
    """Ground height [m] below one place."""
    return height_under(heights, frame, x, y)


@kernel
def heights_at(heights: Any, frame: Any, points: Any) -> Any:
    """Ground heights [S] float64 [m] below places [S, 2]."""
    found = np.empty(len(points))
    for k in range(len(points)):
        found[k] = height_under(heights, frame, points[k, 0], points[k, 1])
    return found


@func
def normal_over(heights: Any, frame: Any, x: float, y: float, yaw: float) -> Any:
    """Unit normal of the plane that rises as the ground does between the wheels of a vehicle that
    stands there with heading ``yaw``."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    fx, fy = HALF_WHEELBASE * cos, HALF_WHEELBASE * sin
    lx, ly = -HALF_TRACK * sin, HALF_TRACK * cos
    ahead = height_under(heights, frame, x + fx, y + fy)
    behind = height_under(heights, frame, x - fx, y - fy)
    left = height_under(heights, frame, x + lx, y + ly)
    right = height_under(heights, frame, x - lx, y - ly)
    rise, lean = (ahead - behind) / (2 * HALF_WHEELBASE), (left - right) / (2 * HALF_TRACK)
    a, b = -(rise * cos - lean * sin), -(rise * sin + lean * cos)
    up = 1.0 / math.sqrt(a * a + b * b + 1.0)
    return a * up, b * up, up


@kernel
def normals_at(heights: Any, frame: Any, points: Any) -> Any:
    """Unit normals [S, 3] float64 of the ground below places [S, 2]."""
    found = np.empty((len(points), 3))
    for k in range(len(points)):
        found[k] = normal_over(heights, frame, points[k, 0], points[k, 1], 0.0)
    return found


@kernel
def pose_at(heights: Any, frame: Any, x: float, y: float, yaw: float) -> Any:
    """``T_world_vehicle`` [4, 4] of a vehicle that stands at (x, y) with heading ``yaw``."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    a, b, c = normal_over(heights, frame, x, y, yaw)
    slope = -(a * cos + b * sin) / c
    length = math.sqrt(1.0 + slope * slope)
    fx, fy, fz = cos / length, sin / length, slope / length
    pose = np.zeros((4, 4))
    pose[0, 0], pose[1, 0], pose[2, 0] = fx, fy, fz
    pose[0, 1], pose[1, 1], pose[2, 1] = b * fz - c * fy, c * fx - a * fz, a * fy - b * fx
    pose[0, 2], pose[1, 2], pose[2, 2] = a, b, c
    pose[0, 3], pose[1, 3] = x, y
    pose[2, 3] = height_under(heights, frame, x, y)
    pose[3, 3] = 1.0
    return pose
