"""Ray casting: bounding volume hierarchies, nearest hit and any hit, in static and moving geometry.

Hierarchies use the binned surface-area heuristic (Wald, "On fast construction of SAH-based bounding
volume hierarchies", 2007).
"""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._numba import func, kernel
from ..geometry import Float
from .mesh import Mesh

# Bounding volume hierarchies.


BINS = 12
LEAF_SIZE = 4
STACK_SIZE = 64


class Geometry(NamedTuple):
    """All meshes of a world, each below its own root node.

    Attributes:
        bounds: [N, 6] low x, y, z, high x, y, z of every node.
        children: [N] uint32, left child (the right one follows it), or a leaf's first triangle.
        counts: [N] uint32, triangles of a leaf, 0 for an inner node.
        edges: [T, 9] first corner and the two edges from it.
        uv: [T, 6] texture coordinates of the three corners.
        normals: [T, 9] unit normals of the three corners.
        material: [T] int32.
        paint: [T] int32.
    """

    bounds: Float
    children: NDArray[np.uint32]
    counts: NDArray[np.uint32]
    edges: Float
    uv: Float
    normals: Float
    material: NDArray[np.int32]
    paint: NDArray[np.int32]


def build_geometry(meshes: list[Mesh]) -> tuple[Geometry, NDArray[np.int64]]:
    """One hierarchy per mesh in common arrays; also the root node [M] of each mesh."""
    parts, roots = [], []
    node_base = triangle_base = 0
    for mesh in meshes:
        low, high = mesh.corners.min(axis=1), mesh.corners.max(axis=1)
        bounds, child, count, order = _build(low, high)
        child = np.where(count > 0, child + triangle_base, child + node_base).astype(np.uint32)
        parts.append((bounds, child, count.astype(np.uint32), *_arrange(mesh, order)))
        roots.append(node_base)
        node_base += len(child)
        triangle_base += len(order)
    return Geometry(*(np.concatenate(columns) for columns in zip(*parts, strict=True))), np.array(
        roots
    )


def append_geometry(
    geometry: Geometry, meshes: list[Mesh]
) -> tuple[Geometry, list[tuple[NDArray[np.int64], int, tuple[int, int]]]]:
    """Append meshes to a geometry, for :func:`refit`.

    Returns:
        The geometry; for each mesh the order of its triangles, the row of the first, and its first
        node and the one after its last.
    """
    parts: list[tuple[NDArray[np.generic], ...]] = [geometry]
    places = []
    node_base, triangle_base = len(geometry.children), len(geometry.edges)
    for mesh in meshes:
        bounds, child, count, order = _build(mesh.corners.min(axis=1), mesh.corners.max(axis=1))
        child = np.where(count > 0, child + triangle_base, child + node_base).astype(np.uint32)
        parts.append((bounds, child, count.astype(np.uint32), *_arrange(mesh, order)))
        places.append((order, triangle_base, (node_base, node_base + len(child))))
        node_base += len(child)
        triangle_base += len(order)
    return Geometry(*(np.concatenate(columns) for columns in zip(*parts, strict=True))), places


@kernel
def refit(
    bounds, children, counts, edges, normals, vertices, vertex_normals, triangles, order,
    first, start, end,
):  # fmt: skip
    """Move a mesh of :func:`append_geometry` to vertices [V, 3] with normals [V, 3], in place."""
    for i in range(len(order)):
        row, triangle = first + i, order[i]
        a, b, c = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
        for axis in range(3):
            edges[row, axis] = vertices[a, axis]
            edges[row, 3 + axis] = vertices[b, axis] - vertices[a, axis]
            edges[row, 6 + axis] = vertices[c, axis] - vertices[a, axis]
            normals[row, axis] = vertex_normals[a, axis]
            normals[row, 3 + axis] = vertex_normals[b, axis]
            normals[row, 6 + axis] = vertex_normals[c, axis]
    # Children come after their node.
    for node in range(end - 1, start - 1, -1):
        child, count = int(children[node]), int(counts[node])
        for axis in range(3):
            low, high = np.inf, -np.inf
            if count > 0:
                for row in range(child, child + count):
                    for corner in range(3):
                        place = vertices[triangles[order[row - first], corner], axis]
                        low, high = min(low, place), max(high, place)
            else:
                low = min(bounds[child, axis], bounds[child + 1, axis])
                high = max(bounds[child, axis + 3], bounds[child + 1, axis + 3])
            bounds[node, axis], bounds[node, axis + 3] = low, high


def _arrange(mesh: Mesh, order: NDArray[np.int64]) -> tuple[NDArray[np.generic], ...]:
    corners = mesh.corners[order]
    edges = np.concatenate(
        [corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1
    )
    return (
        edges,
        mesh.uv[order].reshape(-1, 6),
        mesh.normals[order].reshape(-1, 9),
        mesh.material[order],
        mesh.paint[order],
    )


@kernel
def _build(low, high):
    n = len(low)
    order = np.arange(n)
    centre = 0.5 * (low + high)
    bounds = np.empty((2 * n, 6))
    child = np.zeros(2 * n, np.int32)
    count = np.zeros(2 * n, np.int32)
    first_of = np.zeros(2 * n, np.int64)
    last_of = np.zeros(2 * n, np.int64)
    last_of[0] = n
    used = 1
    node = 0
    while node < used:
        first, last = first_of[node], last_of[node]
        for axis in range(3):
            bounds[node, axis] = np.inf
            bounds[node, axis + 3] = -np.inf
        for i in range(first, last):
            for axis in range(3):
                bounds[node, axis] = min(bounds[node, axis], low[order[i], axis])
                bounds[node, axis + 3] = max(bounds[node, axis + 3], high[order[i], axis])
        middle = first
        if last - first > LEAF_SIZE:
            middle = _partition(order, first, last, low, high, centre)
        if middle in (first, last):
            child[node], count[node] = first, last - first
        else:
            child[node] = used
            first_of[used], last_of[used] = first, middle
            first_of[used + 1], last_of[used + 1] = middle, last
            used += 2
        node += 1
    return bounds[:used], child[:used], count[:used], order


@func
def _partition(order, first, last, low, high, centre):
    best_axis, best_split, best_cost = -1, 0.0, np.inf
    for axis in range(3):
        start, end = np.inf, -np.inf
        for i in range(first, last):
            start = min(start, centre[order[i], axis])
            end = max(end, centre[order[i], axis])
        if end - start < 1e-9:
            continue
        bin_low, bin_high, bin_count = _fill_bins(
            order, first, last, low, high, centre, axis, start, BINS / (end - start)
        )
        for split in range(1, BINS):
            cost = _area(bin_low, bin_high, bin_count, 0, split) + _area(
                bin_low, bin_high, bin_count, split, BINS
            )
            if cost < best_cost:
                best_cost, best_axis = cost, axis
                best_split = start + (end - start) * split / BINS
    if best_axis < 0:
        return first
    i, j = first, last - 1
    while i <= j:
        if centre[order[i], best_axis] < best_split:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i


@func
def _fill_bins(order, first, last, low, high, centre, axis, start, scale):
    bin_low = np.full((BINS, 3), np.inf)
    bin_high = np.full((BINS, 3), -np.inf)
    bin_count = np.zeros(BINS, np.int64)
    for i in range(first, last):
        triangle = order[i]
        b = min(int((centre[triangle, axis] - start) * scale), BINS - 1)
        bin_count[b] += 1
        for k in range(3):
            bin_low[b, k] = min(bin_low[b, k], low[triangle, k])
            bin_high[b, k] = max(bin_high[b, k], high[triangle, k])
    return bin_low, bin_high, bin_count


@func
def _area(bin_low, bin_high, bin_count, first, last):
    """Half surface area of bins first..last times their number of triangles."""
    total = 0
    x = y = z = -np.inf
    a = b = c = np.inf
    for i in range(first, last):
        total += bin_count[i]
        a, b, c = min(a, bin_low[i, 0]), min(b, bin_low[i, 1]), min(c, bin_low[i, 2])
        x, y, z = max(x, bin_high[i, 0]), max(y, bin_high[i, 1]), max(z, bin_high[i, 2])
    if total == 0:
        return np.inf
    return total * ((x - a) * (y - b) + (y - b) * (z - c) + (z - c) * (x - a))


EPSILON = 1e-9


class Instances(NamedTuple):
    """Vehicles at one instant.

    Attributes:
        to_object: [I, 3, 4] world to object.
        to_world: [I, 3, 4] object to world.
        radius: [I] of the sphere around the object's origin [m].
        root: [I] int64, node of the object's mesh.
        shape: [I] int64, row of the shape tables.
        paint: [I] int64, row of the paint table with the body colour.
        half_size: [I, 3] half of (length, width, height) [m].
    """

    to_object: Float
    to_world: Float
    radius: Float
    root: NDArray[np.int64]
    shape: NDArray[np.int64]
    paint: NDArray[np.int64]
    half_size: Float


@func
def new_stack():
    """Scratch memory of one thread for the functions below."""
    return np.empty(STACK_SIZE, np.uint32), np.empty(STACK_SIZE)


@func
def _enter(bounds, node, ox, oy, oz, ix, iy, iz, limit):
    """Distance at which a ray enters a node's box, infinity if it misses."""
    a, b = (bounds[node, 0] - ox) * ix, (bounds[node, 3] - ox) * ix
    near, far = min(a, b), max(a, b)
    a, b = (bounds[node, 1] - oy) * iy, (bounds[node, 4] - oy) * iy
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (bounds[node, 2] - oz) * iz, (bounds[node, 5] - oz) * iz
    near, far = max(near, min(a, b)), min(far, max(a, b))
    if far < 0.0 or near > far or near > limit:
        return np.inf
    return near


@func
def _inverse(x):
    if abs(x) < 1e-12:
        return 1e12 if x >= 0 else -1e12
    return 1.0 / x


@func
def cast_mesh(  # noqa: PLR0912, PLR0915 - one loop; parting it costs a call per node
    bounds, children, counts, edges, root, ox, oy, oz, dx, dy, dz, limit, any_hit, stack
):
    """Nearest hit below ``root``: (distance, triangle, u, v), triangle -1 without a hit.

    With ``any_hit``, returns the first hit found. Source: Moeller and Trumbore, "Fast, minimum
    storage ray/triangle intersection", 1997.
    """
    nodes, entries = stack
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    best, best_triangle, best_u, best_v = limit, np.int64(-1), 0.0, 0.0
    # Unsigned indices avoid a test for negative ones at every access.
    node = np.uint32(root)
    if _enter(bounds, node, ox, oy, oz, ix, iy, iz, best) == np.inf:
        return best, best_triangle, best_u, best_v
    top = 0
    while True:
        count = counts[node]
        child = children[node]
        if count > 0:
            for k in range(child, child + count):
                e1x, e1y, e1z = edges[k, 3], edges[k, 4], edges[k, 5]
                e2x, e2y, e2z = edges[k, 6], edges[k, 7], edges[k, 8]
                px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
                det = e1x * px + e1y * py + e1z * pz
                if abs(det) < 1e-14:
                    continue
                inv = 1.0 / det
                tx, ty, tz = ox - edges[k, 0], oy - edges[k, 1], oz - edges[k, 2]
                u = (tx * px + ty * py + tz * pz) * inv
                if u < -EPSILON or u > 1.0 + EPSILON:
                    continue
                qx, qy, qz = ty * e1z - tz * e1y, tz * e1x - tx * e1z, tx * e1y - ty * e1x
                v = (dx * qx + dy * qy + dz * qz) * inv
                if v < -EPSILON or u + v > 1.0 + EPSILON:
                    continue
                t = (e2x * qx + e2y * qy + e2z * qz) * inv
                if 1e-6 < t < best:
                    best, best_triangle, best_u, best_v = t, np.int64(k), u, v
                    if any_hit:
                        return best, best_triangle, best_u, best_v
        else:
            left = _enter(bounds, child, ox, oy, oz, ix, iy, iz, best)
            right = _enter(bounds, child + 1, ox, oy, oz, ix, iy, iz, best)
            if left <= right:
                if right < np.inf:
                    nodes[top], entries[top] = np.uint32(child + 1), right
                    top += 1
                if left < np.inf:
                    node = child
                    continue
            else:
                if left < np.inf:
                    nodes[top], entries[top] = child, left
                    top += 1
                node = np.uint32(child + 1)
                continue
        while top > 0 and entries[top - 1] > best:
            top -= 1
        if top == 0:
            return best, best_triangle, best_u, best_v
        top -= 1
        node = nodes[top]


@func(forceinline=True)
def _near_instance(instances, i, ox, oy, oz, dx, dy, dz, limit):
    """Whether a ray intersects the bounding sphere of instance i."""
    cx = instances.to_world[i, 0, 3] - ox
    cy = instances.to_world[i, 1, 3] - oy
    cz = instances.to_world[i, 2, 3] - oz
    along = cx * dx + cy * dy + cz * dz
    square = instances.radius[i] * instances.radius[i]
    distance = cx * cx + cy * cy + cz * cz
    if distance <= square:
        return True
    return 0.0 < along < limit + instances.radius[i] and distance - along * along < square


@func(forceinline=True)
def rotate(m, i, x, y, z):
    """Rotation of transform ``m[i]`` applied to a vector."""
    return (
        m[i, 0, 0] * x + m[i, 0, 1] * y + m[i, 0, 2] * z,
        m[i, 1, 0] * x + m[i, 1, 1] * y + m[i, 1, 2] * z,
        m[i, 2, 0] * x + m[i, 2, 1] * y + m[i, 2, 2] * z,
    )


@func(forceinline=True)
def cast(g, instances, ox, oy, oz, dx, dy, dz, limit, stack):
    """Nearest hit in the world: (distance, triangle, u, v, instance), instance -1 for static."""
    best, triangle, u, v = cast_mesh(
        g.bounds, g.children, g.counts, g.edges, 0, ox, oy, oz, dx, dy, dz, limit, False, stack
    )
    instance = -1
    for i in range(len(instances.radius)):
        if not _near_instance(instances, i, ox, oy, oz, dx, dy, dz, best):
            continue
        m = instances.to_object
        px, py, pz = rotate(m, i, ox, oy, oz)
        qx, qy, qz = rotate(m, i, dx, dy, dz)
        t, k, a, b = cast_mesh(
            g.bounds,
            g.children,
            g.counts,
            g.edges,
            instances.root[i],
            px + m[i, 0, 3],
            py + m[i, 1, 3],
            pz + m[i, 2, 3],
            qx,
            qy,
            qz,
            best,
            False,
            stack,
        )
        if k >= 0:
            best, triangle, u, v, instance = t, k, a, b, i
    return best, triangle, u, v, instance


@func(forceinline=True)
def is_blocked(g, instances, ox, oy, oz, dx, dy, dz, limit, stack):
    """Whether a ray hits anything within ``limit``."""
    for i in range(len(instances.radius)):
        if not _near_instance(instances, i, ox, oy, oz, dx, dy, dz, limit):
            continue
        m = instances.to_object
        px, py, pz = rotate(m, i, ox, oy, oz)
        qx, qy, qz = rotate(m, i, dx, dy, dz)
        hit = cast_mesh(
            g.bounds,
            g.children,
            g.counts,
            g.edges,
            instances.root[i],
            px + m[i, 0, 3],
            py + m[i, 1, 3],
            pz + m[i, 2, 3],
            qx,
            qy,
            qz,
            limit,
            True,
            stack,
        )
        if hit[1] >= 0:
            return True
    return (
        cast_mesh(
            g.bounds, g.children, g.counts, g.edges, 0, ox, oy, oz, dx, dy, dz, limit, True, stack
        )[1]
        >= 0
    )
