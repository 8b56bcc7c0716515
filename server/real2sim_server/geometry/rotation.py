"""Rotations in float64 NumPy, as unit quaternions (wxyz) and as matrices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]


def quaternion_to_matrix(quaternion: ArrayLike) -> Float:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] wxyz; they are normalised first."""
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(matrix: ArrayLike) -> Float:
    """Unit quaternions [..., 4] wxyz with w >= 0 of rotation matrices [..., 3, 3].

    Takes the largest of the four candidate components as pivot, so that no rotation is
    ill-conditioned (Shepperd's method).
    """
    m = np.asarray(matrix, dtype=np.float64)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    squares = np.stack(
        [
            1 + trace,
            1 + 2 * m[..., 0, 0] - trace,
            1 + 2 * m[..., 1, 1] - trace,
            1 + 2 * m[..., 2, 2] - trace,
        ],
        axis=-1,
    )
    yz, zx, xy = (
        (m[..., 2, 1], m[..., 1, 2]),
        (m[..., 0, 2], m[..., 2, 0]),
        (m[..., 1, 0], m[..., 0, 1]),
    )
    (dx, sx), (dy, sy), (dz, sz) = ((a - b, a + b) for a, b in (yz, zx, xy))
    candidates = np.stack(
        [
            np.stack([squares[..., 0], dx, dy, dz], axis=-1),
            np.stack([dx, squares[..., 1], sz, sy], axis=-1),
            np.stack([dy, sz, squares[..., 2], sx], axis=-1),
            np.stack([dz, sy, sx, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    pivot = np.argmax(squares, axis=-1)[..., None, None]
    q: Float = np.take_along_axis(
        candidates, np.broadcast_to(pivot, (*pivot.shape[:-1], 4)), axis=-2
    )
    q = q[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def multiply_quaternions(left: ArrayLike, right: ArrayLike) -> Float:
    """Hamilton product [..., 4] of two wxyz quaternions: first ``right``, then ``left`` rotates."""
    aw, ax, ay, az = np.moveaxis(np.asarray(left, dtype=np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(right, dtype=np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def slerp(start: ArrayLike, end: ArrayLike, fraction: ArrayLike) -> Float:
    """Shortest-arc interpolation [..., 4] of unit quaternions, ``fraction`` [...] in [0, 1]."""
    a = np.asarray(start, dtype=np.float64)
    b = np.asarray(end, dtype=np.float64)
    t = np.asarray(fraction, dtype=np.float64)[..., None]
    dot = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(dot < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), -1.0, 1.0))
    sine = np.sin(angle)
    nearly_equal = sine < 1e-6
    safe = np.where(nearly_equal, 1.0, sine)
    weight_a = np.where(nearly_equal, 1 - t, np.sin((1 - t) * angle) / safe)
    weight_b = np.where(nearly_equal, t, np.sin(t * angle) / safe)
    q = weight_a * a + weight_b * b
    between: Float = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return between


def yaw_quaternion(yaw: ArrayLike) -> Float:
    """Quaternions [..., 4] of rotations by ``yaw`` [...] [rad] about z."""
    half = np.asarray(yaw, dtype=np.float64) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def quaternion_yaw(quaternion: ArrayLike) -> Float:
    """Heading [...] [rad] in (-pi, pi] of the rotated x axis, seen from above."""
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def is_rotation(matrix: ArrayLike, *, tolerance: float = 1e-3) -> bool:
    """Whether a [3, 3] matrix is finite, orthonormal and right-handed within ``tolerance``."""
    m = np.asarray(matrix, dtype=np.float64)
    return m.shape == (3, 3) and bool(are_rotations(m, tolerance=tolerance))


def are_rotations(matrices: ArrayLike, *, tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Which of [..., 3, 3] matrices are rotations, [...] bool; like :func:`is_rotation`."""
    m = np.asarray(matrices, dtype=np.float64)
    # By elements: products of many small matrices are calls of a library each.
    x, y, z = ([m[..., i, j] for j in range(3)] for i in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        found = np.isfinite(_dot(x, x) + _dot(y, y) + _dot(z, z))
        for row, other in ((x, y), (y, z), (z, x)):
            found = found & (np.abs(_dot(row, row) - 1) < tolerance)
            found = found & (np.abs(_dot(row, other)) < tolerance)
        cross = [y[i] * z[j] - y[j] * z[i] for i, j in ((1, 2), (2, 0), (0, 1))]
        return np.asarray(found & (_dot(x, cross) > 0))


def _dot(one: Sequence[Float], other: Sequence[Float]) -> Float:
    """Of vectors given by their three components."""
    product: Float = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return product
