"""Ray casting: nearest hit and any hit, in the static world and its moving instances."""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._numba import func
from ..geometry.transform import Float
from .bvh import STACK_SIZE

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
    """Distance at which a ray enters a node's box, infinity where it misses it."""
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
    """Nearest hit below ``root``: (distance, triangle, u, v), triangle -1 where there is none.

    With ``any_hit`` the first one found. Moeller and Trumbore, "Fast, minimum storage ray/triangle
    intersection", 1997.
    """
    nodes, entries = stack
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    best, best_triangle, best_u, best_v = limit, np.int64(-1), 0.0, 0.0
    # Unsigned indices spare the test for negative ones at every access.
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
    """Whether a ray comes close enough to instance i for its mesh to be looked at."""
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
    """Whether anything lies on a ray within ``limit``."""
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
