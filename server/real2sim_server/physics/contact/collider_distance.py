"""Distance to colliders, as packed rows: one function for all shapes that there are."""

# Kernels take arrays by position, and Numba knows no keyword-only arguments.

from __future__ import annotations

import math
from typing import Any

from ..numerics.device import TINY, ZERO, device_function

PLANE, BOX, HEIGHT_FIELD, CYLINDER, CAPSULE, MESH = range(6)

KIND, FRICTION, SEPARABLE = 0, 1, 2
"""FRICTION is negative where the body's own holds."""
POINT, AXES, HALF_SIZE = 3, 6, 15
"""A plane's normal lies in the first three of AXES, a solid's rotation (world from it) in all. Of a
cylinder and a capsule HALF_SIZE holds the radius and half of the height or length."""
SPIN, SPEED = 18, 21
"""Angular and linear velocity, world axes."""
FIRST_HEIGHT, COUNT_X, COUNT_Y, SPACING = 24, 25, 26, 27
"""Of a height field, from where on its heights stand among those of all."""
FIRST_NODE, NODES, HALF_THICKNESS = 24, 25, 27
"""Of a mesh, from where on its boxes and then its triangles stand there, how many boxes there are,
and half the thickness of a sheet, 0 for a closed body."""
THIN = 28
"""1 where a box is thinner than cells of the grid; see ``particle``."""
COLLIDER_ROW = 29
MESH_NODE = 8
"""Numbers of a box of a mesh: low (3), high (3), the box after all within it, triangle or -1."""
MESH_TRIANGLE = 30
"""Numbers of a triangle: corners (9), pseudonormals of face, edges 01, 12, 20, and corners."""
ON_SURFACE = 1e-9
"""Nearer to a mesh than this the pseudonormal is taken for the direction away from it [m]."""


@device_function
def collider_distance(row: Any, heights: Any, x: Any, y: Any, z: Any) -> Any:
    """Signed distance [m] of a point [m] to a collider, and the unit normal out of it.

    Args:
        row: packed collider, columns above.
        heights: of all height fields and meshes, one after the other.
    """
    kind = int(row[KIND])
    if kind == PLANE:
        n = (row[AXES], row[AXES + 1], row[AXES + 2])
        d = (x - row[POINT]) * n[0] + (y - row[POINT + 1]) * n[1] + (z - row[POINT + 2]) * n[2]
        return d, n
    if kind == BOX:
        return box_distance(row, x, y, z)
    if kind == HEIGHT_FIELD:
        return height_distance(row, heights, x, y, z)
    q = into_frame(row, x, y, z)
    if kind == CYLINDER:
        distance, m = cylinder_distance(row[HALF_SIZE], row[HALF_SIZE + 1], q)
    elif kind == CAPSULE:
        distance, m = capsule_distance(row[HALF_SIZE], row[HALF_SIZE + 1], q)
    else:
        distance, m = mesh_distance(row, heights, q)
    return distance, out_of_frame(row, m)


@device_function
def into_frame(row: Any, x: Any, y: Any, z: Any) -> Any:
    """A point of the world in the frame of a solid [m]."""
    px, py, pz = x - row[POINT], y - row[POINT + 1], z - row[POINT + 2]
    qx = row[AXES] * px + row[AXES + 3] * py + row[AXES + 6] * pz
    qy = row[AXES + 1] * px + row[AXES + 4] * py + row[AXES + 7] * pz
    qz = row[AXES + 2] * px + row[AXES + 5] * py + row[AXES + 8] * pz
    return qx, qy, qz


@device_function
def out_of_frame(row: Any, n: Any) -> Any:
    """A direction in the frame of a solid in the world."""
    return (
        row[AXES] * n[0] + row[AXES + 1] * n[1] + row[AXES + 2] * n[2],
        row[AXES + 3] * n[0] + row[AXES + 4] * n[1] + row[AXES + 5] * n[2],
        row[AXES + 6] * n[0] + row[AXES + 7] * n[1] + row[AXES + 8] * n[2],
    )


@device_function
def box_distance(row: Any, x: Any, y: Any, z: Any) -> Any:
    """Distance to an oriented box; inside it the normal is that of the nearest face."""
    qx, qy, qz = into_frame(row, x, y, z)
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
    return distance, out_of_frame(row, (nx, ny, nz))


@device_function
def cylinder_distance(radius: Any, half: Any, q: Any) -> Any:
    """Distance to a cylinder about z; inside it the normal is that of the nearest side or end."""
    across = math.sqrt(q[0] * q[0] + q[1] * q[1])
    cx, cy = 1.0, 0.0
    if across > 0.0:
        cx, cy = q[0] / across, q[1] / across
    up = math.copysign(1.0, q[2])
    side, end = across - radius, abs(q[2]) - half
    if side > 0.0 and end > 0.0:
        distance = math.sqrt(side * side + end * end)
        out, along = side / distance, end / distance
    elif side > end:
        distance, out, along = side, 1.0, 0.0
    else:
        distance, out, along = end, 0.0, 1.0
    return distance, (out * cx, out * cy, along * up)


@device_function
def capsule_distance(radius: Any, half: Any, q: Any) -> Any:
    """Distance to all within ``radius`` of a line along z."""
    z = q[2] - min(max(q[2], -half), half)
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + z * z)
    if length > 0.0:
        return length - radius, (q[0] / length, q[1] / length, z / length)
    return -radius, (1.0, 0.0, 0.0)


@device_function
def mesh_distance(row: Any, data: Any, q: Any) -> Any:
    """Distance to a closed mesh, signed, or to a sheet; the normal at the nearest place of it."""
    first, count = int(row[FIRST_NODE]), int(row[NODES])
    triangles = first + MESH_NODE * count
    best, found, part = math.inf, triangles, 0
    px, py, pz = 0.0, 0.0, 0.0
    node = 0
    while node < count:
        at = first + MESH_NODE * node
        dx = max(data[at] - q[0], q[0] - data[at + 3], 0.0)
        dy = max(data[at + 1] - q[1], q[1] - data[at + 4], 0.0)
        dz = max(data[at + 2] - q[2], q[2] - data[at + 5], 0.0)
        if dx * dx + dy * dy + dz * dz >= best:
            node = int(data[at + 6])
        else:
            node += 1
            own = int(data[at + 7])
            if own >= 0:
                triangle = triangles + MESH_TRIANGLE * own
                x, y, z, where = nearest_of_triangle(data, triangle, q)
                square = (q[0] - x) ** 2 + (q[1] - y) ** 2 + (q[2] - z) ** 2
                if square < best:
                    best, found, part = square, triangle, where
                    px, py, pz = x, y, z
    distance = math.sqrt(best)
    at = found + 9 + 3 * part
    n = (data[at], data[at + 1], data[at + 2])
    away = (q[0] - px, q[1] - py, q[2] - pz)
    sheet = row[HALF_THICKNESS]
    if sheet == 0.0 and away[0] * n[0] + away[1] * n[1] + away[2] * n[2] < 0.0:
        distance = -distance
    if abs(distance) > ON_SURFACE:
        n = (away[0] / distance, away[1] / distance, away[2] / distance)
    return distance - sheet, n


@device_function
def nearest_of_triangle(data: Any, at: Any, q: Any) -> Any:
    """The place on a triangle that is nearest to a point, and which part of it that lies on.

    Parts are numbered as pseudonormals are: 0 the face, 1 to 3 edges, 4 to 6 corners (Ericson 2005,
    5.1.5).
    """
    ax, ay, az = data[at], data[at + 1], data[at + 2]
    ux, uy, uz = data[at + 3] - ax, data[at + 4] - ay, data[at + 5] - az
    wx, wy, wz = data[at + 6] - ax, data[at + 7] - ay, data[at + 8] - az
    qx, qy, qz = q[0] - ax, q[1] - ay, q[2] - az
    d1, d2 = ux * qx + uy * qy + uz * qz, wx * qx + wy * qy + wz * qz
    uu, uw = ux * ux + uy * uy + uz * uz, ux * wx + uy * wy + uz * wz
    ww = wx * wx + wy * wy + wz * wz
    d3, d4 = d1 - uu, d2 - uw
    d5, d6 = d1 - uw, d2 - ww
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        s, t, part = 0.0, 0.0, 4
    elif d3 >= 0.0 and d4 <= d3:
        s, t, part = 1.0, 0.0, 5
    elif d6 >= 0.0 and d5 <= d6:
        s, t, part = 0.0, 1.0, 6
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s, t, part = d1 / (d1 - d3), 0.0, 1
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s, part = 1.0 - t, 2
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s, t, part = 0.0, d2 / (d2 - d6), 3
    else:
        whole = va + vb + vc
        s, t, part = vb / whole, vc / whole, 0
    return ax + s * ux + t * wx, ay + s * uy + t * wy, az + s * uz + t * wz, part


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
