"""Kernels of skinning."""

from __future__ import annotations

import numpy as np
from numba import prange

from .._numba import kernel


@kernel(parallel=True)
def skin_vertices(vertices, weight_joints, weights, transforms):
    """Vertices [N, V, 3] of poses [N, J, 3, 4]; see :func:`.skinning.skin`."""
    poses, count = len(transforms), len(vertices)
    out = np.empty((poses, count, 3))
    for i in prange(poses * count):
        pose, v = i // count, i % count
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        for axis in range(3):
            total = 0.0
            for k in range(weights.shape[1]):
                m = transforms[pose, weight_joints[v, k]]
                moved = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3]
                total += weights[v, k] * moved
            out[pose, v, axis] = total
    return out


@kernel
def mesh_normals(vertices, triangles):
    """See :func:`.skinning.vertex_normals`."""
    out = np.zeros_like(vertices)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ux, uy, uz = vertices[b] - vertices[a]
        vx, vy, vz = vertices[c] - vertices[a]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for corner in (a, b, c):
            out[corner, 0] += nx
            out[corner, 1] += ny
            out[corner, 2] += nz
    for i in range(len(out)):
        length = np.sqrt(out[i, 0] ** 2 + out[i, 1] ** 2 + out[i, 2] ** 2)
        out[i] /= max(length, 1e-12)
    return out
