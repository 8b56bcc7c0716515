"""Contact of bodies with colliders and with each other; functions shared by all devices.

Colliders are packed rows with one distance function for all shapes. Contact acts on grid nodes. A
collider that is thin compared with the cells can fall between the nodes, so thin colliders also act
on particles: the kernel follows a particle's path through the substep to the first touch and
removes the velocity that would move it further inside.
"""

# Kernels take arrays by position: Numba has no keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .numerics import F32, ONE, TINY, ZERO, device_function

PLANE, BOX, HEIGHT_FIELD, CYLINDER, CAPSULE, MESH = range(6)

KIND, FRICTION, SEPARABLE = 0, 1, 2
"""A negative FRICTION selects the coefficient of the body."""
POINT, AXES, HALF_SIZE = 3, 6, 15
"""AXES holds a plane's normal (first three numbers) or a solid's rotation (world from solid).
HALF_SIZE of a cylinder or a capsule is its radius and half its height or length."""
SPIN, SPEED = 18, 21
"""Angular and linear velocity, world axes [rad/s], [m/s]."""
FIRST_HEIGHT, COUNT_X, COUNT_Y, SPACING = 24, 25, 26, 27
"""Height field: offset of its first height in ``heights``, number of samples, spacing [m]."""
FIRST_NODE, NODES, HALF_THICKNESS = 24, 25, 27
"""Mesh: offset of its bounding boxes in ``heights``, followed by its triangles; number of boxes;
half the thickness of a sheet [m], 0 for a closed mesh."""
THIN = 28
"""1 if the collider is thin compared with the cells; see ``resolve_particle_collider``."""
COLLIDER_ROW = 29
MESH_NODE = 8
"""Numbers per bounding box of a mesh: low (3), high (3), index of the next box outside its subtree,
triangle or -1."""
MESH_TRIANGLE = 30
"""Numbers per triangle: corners (9), pseudonormals of the face, edges 01, 12, 20, and corners."""
ON_SURFACE = 1e-9
"""Closer to a mesh than this, the normal is the pseudonormal [m]."""


@device_function
def collider_distance(row: Any, heights: Any, x: Any, y: Any, z: Any) -> Any:
    """Signed distance [m] of a point [m] to a collider, and the outward unit normal.

    Args:
        row: packed collider, columns above.
        heights: concatenated data of all height fields and meshes.
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
    """A world point in the frame of a solid [m]."""
    px, py, pz = x - row[POINT], y - row[POINT + 1], z - row[POINT + 2]
    qx = row[AXES] * px + row[AXES + 3] * py + row[AXES + 6] * pz
    qy = row[AXES + 1] * px + row[AXES + 4] * py + row[AXES + 7] * pz
    qz = row[AXES + 2] * px + row[AXES + 5] * py + row[AXES + 8] * pz
    return qx, qy, qz


@device_function
def out_of_frame(row: Any, n: Any) -> Any:
    """A direction, from the frame of a solid to the world frame."""
    return (
        row[AXES] * n[0] + row[AXES + 1] * n[1] + row[AXES + 2] * n[2],
        row[AXES + 3] * n[0] + row[AXES + 4] * n[1] + row[AXES + 5] * n[2],
        row[AXES + 6] * n[0] + row[AXES + 7] * n[1] + row[AXES + 8] * n[2],
    )


@device_function
def box_distance(row: Any, x: Any, y: Any, z: Any) -> Any:
    """Distance to an oriented box; inside, the normal is that of the nearest face."""
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
    """Distance to a cylinder about z; inside, the normal is that of the nearest side or end."""
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
    """Distance to a capsule along z."""
    z = q[2] - min(max(q[2], -half), half)
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + z * z)
    if length > 0.0:
        return length - radius, (q[0] / length, q[1] / length, z / length)
    return -radius, (1.0, 0.0, 0.0)


@device_function
def mesh_distance(row: Any, data: Any, q: Any) -> Any:
    """Distance to a closed mesh (signed) or to a sheet, and the normal at the nearest point."""
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
    """The nearest point on a triangle, and the feature it is on.

    Features are numbered like pseudonormals: 0 face, 1 to 3 edges, 4 to 6 corners (Ericson 2005,
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
    """Distance to bilinear ground, along the normal at the point's x and y."""
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
    """Direction and length of a vector; the zero vector stays zero."""
    length = math.sqrt(x * x + y * y + z * z)
    inverse = 1.0 / max(length, TINY)  # type: ignore[operator]
    return (x * inverse, y * inverse, z * inverse), length


# Surfaces seen from a grid node, and the velocity after contact.

REACH = F32(1.5)
"""Half width of the spline [cells]: a node sees particles up to this distance."""
_ENTRIES = 256
STICKS = F32(1e6)
"""Represents infinite friction: infinity times a pressure of zero would be NaN."""


def _half_space_tables() -> Any:
    """Lookup tables for a half-space u > surface seen from a node [cells].

    Two tables with even steps: surface by centroid in [0, 1.5], and first moment by filled
    fraction.
    """
    u = np.linspace(-1.5, 1.5, 60_001)
    a = np.abs(u)
    n = np.where(a < 0.5, 0.75 - a**2, 0.5 * (1.5 - a) ** 2) * (u[1] - u[0])
    filled = np.cumsum(n[::-1])[::-1]
    moment = np.cumsum((u * n)[::-1])[::-1]
    centroid = moment / np.maximum(filled, 1e-300)
    centroid[-1] = 1.5
    even = np.linspace(0.0, 1.0, _ENTRIES + 1)
    surface = np.interp(1.5 * even, centroid, u)
    return surface.astype(np.float32), np.interp(even, filled[::-1], moment[::-1]).astype(
        np.float32
    )


SURFACE, FLAT_MOMENT = _half_space_tables()
OPPOSED = F32(0.5)
"""Minimum cosine between opposed surface normals for contact."""
INSIDE = F32(0.25)
"""A body with its centroid this close to a node surrounds it and has no normal there [cells]."""
CRUSHED = F32(1.1)
"""Minimum rest volumes per cell of a crushed body. An intact body that slides past a node also
surrounds it, but at rest density."""


@device_function
def surface_offset(centroid: Any) -> Any:
    """Surface of a body along its inward normal, seen from a node [cells].

    Args:
        centroid: inward offset of the centroid of the body's mass near the node [cells].

    The body is approximated by a half-space. Deep inside, the result is -1.5.
    """
    if centroid <= ZERO:
        return -REACH + ZERO * centroid
    scaled = min(centroid / REACH, ONE) * F32(_ENTRIES)
    index = min(int(scaled), _ENTRIES - 1)
    fraction = scaled - F32(index)
    low, high = SURFACE[index], SURFACE[index + 1]
    return low + fraction * (high - low)


@device_function
def face_score(moment: Any, filled: Any) -> Any:
    """How well a body's first moment [cells] determines the normal; higher for faces.

    Args:
        moment: length of the first moment of the filled fraction.
        filled: filled fraction of the node's surroundings.

    At a given filled fraction, a face has the largest moment; edges and corners have less.
    """
    scaled = min(filled, ONE) * F32(_ENTRIES)
    index = min(int(scaled), _ENTRIES - 1)
    fraction = scaled - F32(index)
    flat = FLAT_MOMENT[index] + fraction * (FLAT_MOMENT[index + 1] - FLAT_MOMENT[index])
    # Compressed material has larger moments than a face, and a filled fraction above 1.
    likeness = min(moment / max(flat, F32(1e-3)), ONE)
    return likeness * likeness * moment


@device_function
def coulomb(v: Any, n: Any, friction: Any, separable: Any) -> Any:
    """Relative velocity after contact: no approach along ``n``, Coulomb friction across it.

    Args:
        v: [3] velocity relative to the other body or collider [m/s].
        n: outward unit normal of the other.
        friction: Coulomb coefficient; nothing slides from STICKS on.
        separable: if false, the contact also keeps the bodies from separating.

    v_t' = max(0, 1 - mu |v_n| / |v_t|) v_t. Never adds kinetic energy.
    """
    approach = v[0] * n[0] + v[1] * n[1] + v[2] * n[2]
    if approach >= ZERO and separable:
        return v
    if friction >= STICKS:
        return ZERO * v[0], ZERO * v[1], ZERO * v[2]
    t = (v[0] - approach * n[0], v[1] - approach * n[1], v[2] - approach * n[2])
    speed = math.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    keep = ZERO * speed
    if speed > TINY:
        keep = max(ONE - friction * abs(approach) / speed, ZERO * speed)
    return keep * t[0], keep * t[1], keep * t[2]


# Contact at one node, of a body with a collider or of two bodies. Array arguments are rows of the
# node: velocity and mass [4], first moment of volume and volume [4], and contact totals [TOTALS].


ON_FACE = 1e-4
"""A node this close to a face of a thin solid, or to half a cell beyond its edges, counts as on it
[cells]. Centroids have rounding errors, and nodes often coincide with faces."""
THIN_MARGIN = 0.2
"""Nodes stop a body this far in front of a thin solid [cells]. The body still sinks in by up to a
third of a cell as it stops, and contact of particles loses its elastic energy."""


@device_function
def resolve_node_collider(
    row: Any, heights: Any, dx: Any, body_friction: Any, at: Any, node: Any, moment: Any, total: Any
) -> None:
    """Contact of one body's node at ``at`` with one collider, if the surfaces touch."""
    margin = 0.0
    if row[THIN] > 0.5:
        distance, n = distance_behind(row, heights, dx, at, moment)
        margin = THIN_MARGIN
    else:
        distance, n = collider_distance(row, heights, at[0], at[1], at[2])
    if distance > 0.0:
        return
    depth = (moment[0] * n[0] + moment[1] * n[1] + moment[2] * n[2]) / moment[3]
    if distance / dx + surface_offset(depth) > margin:
        return
    friction = row[FRICTION] if row[FRICTION] >= ZERO else body_friction
    u = collider_velocity(row, at[0], at[1], at[2])
    apply_contact(node, n, u, friction, row[SEPARABLE] > 0.5, at, total)


@device_function
def distance_behind(row: Any, heights: Any, dx: Any, at: Any, moment: Any) -> Any:
    """Distance [m] of a node to the face of a thin solid on the body's side, and the normal.

    A node behind a thin solid can represent material in front of it. The centroid of the body's
    volume near the node determines the side. Behind that face, or behind its tangent plane, the
    solid counts as thick, up to half a cell beyond its edges.
    """
    per_volume = dx / moment[3]
    out = (moment[0] * per_volume, moment[1] * per_volume, moment[2] * per_volume)
    distance, n = collider_distance(row, heights, at[0] + out[0], at[1] + out[1], at[2] + out[2])
    distance -= out[0] * n[0] + out[1] * n[1] + out[2] * n[2] + ON_FACE * dx
    across, _ = collider_distance(
        row, heights, at[0] - distance * n[0], at[1] - distance * n[1], at[2] - distance * n[2]
    )
    if across > (0.5 + ON_FACE) * dx:
        distance = across
    return distance, n


@device_function
def apply_contact(
    node: Any, n: Any, u: Any, friction: Any, separable: Any, at: Any, total: Any
) -> None:
    """Contact of a node with a collider that moves at ``u``; adds to the totals."""
    relative = (node[0] - u[0], node[1] - u[1], node[2] - u[2])
    after = coulomb(relative, n, friction, separable)
    change = (after[0] - relative[0], after[1] - relative[1], after[2] - relative[2])
    if change[0] != 0.0 or change[1] != 0.0 or change[2] != 0.0:
        for axis in range(3):
            node[axis] = u[axis] + after[axis]
        m = node[3]
        impulse = (m * change[0], m * change[1], m * change[2])
        record_impulse(impulse, after, u, at, 1.0, total)


@device_function
def record_impulse(impulse: Any, slip: Any, other: Any, at: Any, fraction: Any, total: Any) -> None:
    """Add an impulse at a point, its friction work and its work; see ``model.TOTALS``."""
    px, py, pz = impulse
    total[0] += px
    total[1] += py
    total[2] += pz
    total[3] += at[1] * pz - at[2] * py
    total[4] += at[2] * px - at[0] * pz
    total[5] += at[0] * py - at[1] * px
    total[6] -= fraction * (px * slip[0] + py * slip[1] + pz * slip[2])
    total[7] += px * other[0] + py * other[1] + pz * other[2]


@device_function
def pair_friction(a: Any, b: Any) -> Any:
    """Coulomb coefficient between two surfaces."""
    return math.sqrt(a * b)


@device_function
def resolve_node_pair(
    node_a: Any, node_b: Any, moment_a: Any, moment_b: Any,
    friction: Any, dx: Any, at: Any, total_a: Any, total_b: Any,
) -> None:  # fmt: skip
    """Contact of two bodies at a node, if their surfaces touch.

    The normal is that of the body whose surface at the node is more like a face, because an edge
    could plough through a face along its own normal. Surfaces that do not face each other have no
    contact, unless one body is crushed and surrounds the node. Each surface is approximated by a
    half-space with the same centroid.
    """
    ma, mb = node_a[3], node_b[3]
    volume_a, volume_b = moment_a[3], moment_b[3]
    into_b, size_b = unit(moment_b[0], moment_b[1], moment_b[2])
    out_of_a, size_a = unit(-moment_a[0], -moment_a[1], -moment_a[2])
    facing = into_b[0] * out_of_a[0] + into_b[1] * out_of_a[1] + into_b[2] * out_of_a[2]
    per_cell = 1.0 / (dx * dx * dx)
    if facing < OPPOSED:
        around_a = size_a <= INSIDE * volume_a and volume_a * per_cell >= CRUSHED
        around_b = size_b <= INSIDE * volume_b and volume_b * per_cell >= CRUSHED
        if not (around_a or around_b):
            return
    score_a = face_score(size_a * per_cell, volume_a * per_cell)
    score_b = face_score(size_b * per_cell, volume_b * per_cell)
    n = out_of_a if score_a > score_b else into_b
    depth_a = -(moment_a[0] * n[0] + moment_a[1] * n[1] + moment_a[2] * n[2]) / volume_a
    depth_b = (moment_b[0] * n[0] + moment_b[1] * n[1] + moment_b[2] * n[2]) / volume_b
    if surface_offset(depth_a) + surface_offset(depth_b) > ZERO:
        return
    relative = (node_b[0] - node_a[0], node_b[1] - node_a[1], node_b[2] - node_a[2])
    after = coulomb(relative, n, friction, True)
    change = (after[0] - relative[0], after[1] - relative[1], after[2] - relative[2])
    if change[0] != 0.0 or change[1] != 0.0 or change[2] != 0.0:
        reduced = ma * mb / (ma + mb)
        on_b = (reduced * change[0], reduced * change[1], reduced * change[2])
        on_a = (-on_b[0], -on_b[1], -on_b[2])
        for axis in range(3):
            node_a[axis] += on_a[axis] / ma
            node_b[axis] += on_b[axis] / mb
        record_impulse(on_a, (-after[0], -after[1], -after[2]), node_b, at, 0.5, total_a)
        record_impulse(on_b, after, node_a, at, 0.5, total_b)


# Contact of one particle with a thin collider.


THIN_CELLS = 2.0
"""A solid thinner than this many cells counts as thin, and so does every mesh. It can contain less
than two layers of nodes, and one layer leaks under pressure (measured: plates of 1.5 cells leak at
some positions on the grid, plates of 2 cells at none)."""
SINK = 0.5
"""Distance to a face at which particles stop, in halves of their spacing. Nodes stop a body first.
"""
TOUCHING = 1e-3
"""Tolerance of that distance for a touch, in halves of the spacing."""
LOOKS = 12
"""Maximum number of sphere tracing steps along a particle's path."""
MISSES = 2.0
"""Fraction of a path that means no contact."""


@device_function
def half_spacing(volume: Any) -> Any:
    """Half the spacing [m] of particles of ``volume`` [m^3]."""
    return 0.5 * float(volume) ** (1.0 / 3.0)


@device_function
def entry(q: Any, w: Any, stop: Any, tolerance: Any, holds: Any) -> Any:
    """Fraction of a path along one axis at which ``stop`` is reached from outside, or MISSES.

    Args:
        q, w: position and displacement along the axis, from the centre of the box [m].
        stop: distance from the centre at which particles stop [m].
        tolerance: [m].
        holds: whether the contact is not separable.
    """
    gap = abs(q) - stop
    if gap < -tolerance:
        return MISSES
    if holds and gap <= tolerance:
        return 0.0
    inward = -w if q > 0.0 else w
    if inward <= 0.0 or gap > inward:
        return MISSES
    return max(gap, 0.0) / inward


@device_function
def first_touch(row: Any, heights: Any, at: Any, way: Any, half: Any) -> Any:
    """Fraction of a path at which a particle touches a thin solid, and the outward normal.

    Args:
        row, heights: packed solid, see ``collider_distance``.
        at: start position of the particle [m].
        way: its displacement relative to the solid [m].
        half: half the particle spacing [m].

    Returns:
        Fraction in [0, 1], or MISSES, and the unit normal.
    """
    if int(row[KIND]) == BOX:
        return touch_of_box(row, at, way, half)
    return touch_of_surface(row, heights, at, way, half)


@device_function
def touch_of_surface(row: Any, heights: Any, at: Any, way: Any, half: Any) -> Any:
    """``first_touch`` for any solid, by sphere tracing along its distance function.

    Particles are balls with the radius ``half``, so that round posts do not pass between their
    rows.
    """
    length = math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    stop, near = half, TOUCHING * half
    distance, n = collider_distance(row, heights, at[0], at[1], at[2])
    gap, t = distance - stop, 0.0
    if gap < -near or (row[SEPARABLE] < 0.5 and gap <= near):
        return 0.0, n
    for _ in range(LOOKS):
        inward = -(way[0] * n[0] + way[1] * n[1] + way[2] * n[2])
        if gap <= near:
            return (t if inward > 0.0 else MISSES), face_on(row, way, length, n, half)
        t += gap / max(length, TINY)
        if t > 1.0:
            return MISSES, n
        distance, n = collider_distance(
            row, heights, at[0] + t * way[0], at[1] + t * way[1], at[2] + t * way[2]
        )
        gap = distance - stop
    return t, n


@device_function
def face_on(row: Any, way: Any, length: Any, n: Any, half: Any) -> Any:
    """The normal ``n`` of a touch, turned against the motion for round posts thinner than the
    spacing.

    Such a post stops the particle rows on both sides instead of parting them.
    """
    kind = int(row[KIND])
    if not CYLINDER <= kind <= CAPSULE or row[HALF_SIZE] >= half:
        return n
    own = row[HALF_SIZE] / half
    against = (1.0 - own) / max(length, TINY)
    x, y, z = (
        own * n[0] - against * way[0],
        own * n[1] - against * way[1],
        own * n[2] - against * way[2],
    )
    turned, _ = unit(x, y, z)
    return turned


@device_function
def touch_of_box(row: Any, at: Any, way: Any, half: Any) -> Any:
    """``first_touch`` for a box.

    A particle stops in front of a face if it meets the face within half a spacing beyond its edges.
    A post therefore does not pass between two rows of particles or push them aside.
    """
    px, py, pz = at[0] - row[POINT], at[1] - row[POINT + 1], at[2] - row[POINT + 2]
    t, axis, sign = MISSES, 0, 1.0
    deepest, inner, inner_sign = -1e30, 0, 1.0
    for k in range(3):
        q = row[AXES + k] * px + row[AXES + 3 + k] * py + row[AXES + 6 + k] * pz
        w = row[AXES + k] * way[0] + row[AXES + 3 + k] * way[1] + row[AXES + 6 + k] * way[2]
        stop = row[HALF_SIZE + k] + SINK * half
        outer = 1.0 if q > 0.0 else -1.0
        if abs(q) - stop > deepest:
            deepest, inner, inner_sign = abs(q) - stop, k, outer
        tk = entry(q, w, stop, TOUCHING * half, row[SEPARABLE] < 0.5)
        if tk < t:
            beside = False
            for other in range(3):
                o = row[AXES + other] * (px + tk * way[0])
                o += row[AXES + 3 + other] * (py + tk * way[1])
                o += row[AXES + 6 + other] * (pz + tk * way[2])
                if other != k and abs(o) > row[HALF_SIZE + other] + half:
                    beside = True
            if not beside:
                t, axis, sign = tk, k, outer
    if deepest < -TOUCHING * half:
        t, axis, sign = 0.0, inner, inner_sign
    return t, (sign * row[AXES + axis], sign * row[AXES + 3 + axis], sign * row[AXES + 6 + axis])


@device_function
def resolve_particle_collider(
    row: Any, heights: Any, dt: Any, body_friction: Any, volume: Any, at: Any, v: Any, m: Any,
    total: Any,
) -> Any:  # fmt: skip
    """Velocity of a particle at ``at`` after contact with a thin collider; adds to the totals.

    Keeps the velocity that brings the particle to the surface within the substep.
    """
    u = collider_velocity(row, at[0], at[1], at[2])
    relative = (v[0] - u[0], v[1] - u[1], v[2] - u[2])
    way = (dt * relative[0], dt * relative[1], dt * relative[2])
    t, n = first_touch(row, heights, at, way, half_spacing(volume))
    if t > 1.0:
        return v
    approach = t * (relative[0] * n[0] + relative[1] * n[1] + relative[2] * n[2])
    rest = (approach * n[0], approach * n[1], approach * n[2])
    stopped = (relative[0] - rest[0], relative[1] - rest[1], relative[2] - rest[2])
    friction = row[FRICTION] if row[FRICTION] >= ZERO else body_friction
    after = coulomb(stopped, n, friction, row[SEPARABLE] > 0.5)
    change = (after[0] - stopped[0], after[1] - stopped[1], after[2] - stopped[2])
    if change[0] == 0.0 and change[1] == 0.0 and change[2] == 0.0:
        return v
    impulse = (m * change[0], m * change[1], m * change[2])
    slip = (after[0] + rest[0], after[1] + rest[1], after[2] + rest[2])
    record_impulse(impulse, slip, u, at, 1.0, total)
    return (u[0] + slip[0], u[1] + slip[1], u[2] + slip[2])
