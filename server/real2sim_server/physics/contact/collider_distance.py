"""Distance to colliders, as packed rows: one function for planes, boxes and height fields."""

from __future__ import annotations

import math
from typing import Any

from ..numerics.device import TINY, ZERO, device_function

PLANE, BOX, HEIGHT_FIELD = range(3)

KIND, FRICTION, SEPARABLE = 0, 1, 2
"""FRICTION is negative where the body's own holds."""
POINT, AXES, HALF_SIZE = 3, 6, 15
"""A plane's normal lies in the first three of AXES, a box's rotation (world from box) in all."""
SPIN, SPEED = 18, 21
"""Angular and linear velocity, world axes."""
FIRST_HEIGHT, COUNT_X, COUNT_Y, SPACING = 24, 25, 26, 27
THIN = 28
"""1 where a box is thinner than cells of the grid; see ``particle``."""
COLLIDER_ROW = 29


@device_function
def collider_distance(row: Any, heights: Any, x: Any, y: Any, z: Any) -> Any:
    """Signed distance [m] of a point [m] to a collider, and the unit normal out of it.

    Args:
        row: packed collider, columns above.
        heights: heights of all height fields, one after the other.
    """
    kind = int(row[KIND])
    if kind == PLANE:
        n = (row[AXES], row[AXES + 1], row[AXES + 2])
        d = (x - row[POINT]) * n[0] + (y - row[POINT + 1]) * n[1] + (z - row[POINT + 2]) * n[2]
        return d, n
    if kind == BOX:
        return box_distance(row, x, y, z)
    return height_distance(row, heights, x, y, z)


@device_function
def box_distance(row: Any, x: Any, y: Any, z: Any) -> Any:
    """Distance to an oriented box; inside it the normal is that of the nearest face."""
    px, py, pz = x - row[POINT], y - row[POINT + 1], z - row[POINT + 2]
    qx = row[AXES] * px + row[AXES + 3] * py + row[AXES + 6] * pz
    qy = row[AXES + 1] * px + row[AXES + 4] * py + row[AXES + 7] * pz
    qz = row[AXES + 2] * px + row[AXES + 5] * py + row[AXES + 8] * pz
    dx = abs(qx) - row[HALF_SIZE]
    dy = abs(qy) - row[HALF_SIZE + 1]
    dz = abs(qz) - row[HALF_SIZE + 2]
    deepest = max(dx, dy, dz)
    if deepest > ZERO:
        nx, ny, nz = max(dx, ZERO), max(dy, ZERO), max(dz, ZERO)
        distance = math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / distance, ny / distance, nz / distance
    else:
        distance = deepest
        along_x, along_y = dx == deepest, dy == deepest
        nx = 1.0 if along_x else 0.0
        ny = 1.0 if along_y and not along_x else 0.0
        nz = 0.0 if along_x or along_y else 1.0
    nx, ny, nz = math.copysign(nx, qx), math.copysign(ny, qy), math.copysign(nz, qz)
    return distance, (
        row[AXES] * nx + row[AXES + 1] * ny + row[AXES + 2] * nz,
        row[AXES + 3] * nx + row[AXES + 4] * ny + row[AXES + 5] * nz,
        row[AXES + 6] * nx + row[AXES + 7] * ny + row[AXES + 8] * nz,
    )


@device_function
def height_distance(row: Any, heights: Any, x: Any, y: Any, z: Any) -> Any:
    """Distance to bilinear ground, along the normal under the point."""
    first, nx, ny = int(row[FIRST_HEIGHT]), int(row[COUNT_X]), int(row[COUNT_Y])
    u = min(max((x - row[POINT]) / row[SPACING], 0.0), float(nx - 1))
    v = min(max((y - row[POINT + 1]) / row[SPACING], 0.0), float(ny - 1))
    i, j = min(int(u), nx - 2), min(int(v), ny - 2)
    a, b = u - i, v - j
    h00, h01 = heights[first + i * ny + j], heights[first + i * ny + j + 1]
    h10, h11 = heights[first + (i + 1) * ny + j], heights[first + (i + 1) * ny + j + 1]
    slope_x = ((h10 - h00) * (1.0 - b) + (h11 - h01) * b) / row[SPACING]
    slope_y = ((h01 - h00) * (1.0 - a) + (h11 - h10) * a) / row[SPACING]
    height = (h00 * (1.0 - a) + h10 * a) * (1.0 - b) + (h01 * (1.0 - a) + h11 * a) * b
    up = 1.0 / math.sqrt(slope_x * slope_x + slope_y * slope_y + 1.0)
    return (z - height) * up, (-slope_x * up, -slope_y * up, up)


@device_function
def collider_velocity(row: Any, x: Any, y: Any, z: Any) -> Any:
    """Velocity [m/s] of the collider's material at a point [m]."""
    px, py, pz = x - row[POINT], y - row[POINT + 1], z - row[POINT + 2]
    wx, wy, wz = row[SPIN], row[SPIN + 1], row[SPIN + 2]
    return (
        row[SPEED] + wy * pz - wz * py,
        row[SPEED + 1] + wz * px - wx * pz,
        row[SPEED + 2] + wx * py - wy * px,
    )


@device_function
def unit(x: Any, y: Any, z: Any) -> Any:
    """Direction of a vector and its length; the zero vector stays zero."""
    length = math.sqrt(x * x + y * y + z * z)
    inverse = 1.0 / max(length, TINY)  # type: ignore[operator]
    return (x * inverse, y * inverse, z * inverse), length
