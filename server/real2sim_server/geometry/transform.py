"""Rigid transforms and rotations in float64 NumPy.

``T_dst_src`` is [4, 4] and maps src coordinates to dst; quaternions are (w, x, y, z).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

# --- Rotations -----------------------------------------------------------------------------------

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
    """Dot product of vectors given by their three components."""
    product: Float = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return product


def transform_from(position: ArrayLike, quaternion: ArrayLike) -> Float:
    """``T_dst_src`` [..., 4, 4] of a position [..., 3] [m] and a quaternion [..., 4] wxyz."""
    p = np.asarray(position, dtype=np.float64)
    matrix = np.zeros((*p.shape[:-1], 4, 4))
    matrix[..., :3, :3] = quaternion_to_matrix(quaternion)
    matrix[..., :3, 3] = p
    matrix[..., 3, 3] = 1
    return matrix


def invert_transform(transform: ArrayLike) -> Float:
    """``T_src_dst`` [..., 4, 4] of a rigid ``T_dst_src``."""
    t = np.asarray(transform, dtype=np.float64)
    inverse = np.zeros_like(t)
    rotation = np.swapaxes(t[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, t[..., :3, 3])
    inverse[..., 3, 3] = 1
    return inverse


def apply_transform(transform: ArrayLike, points: ArrayLike) -> Float:
    """Points [..., N, 3] of src in dst, by ``T_dst_src`` [..., 4, 4]."""
    t = np.asarray(transform, dtype=np.float64)
    p = np.asarray(points, dtype=np.float64)
    return p @ np.swapaxes(t[..., :3, :3], -1, -2) + t[..., None, :3, 3]


def is_rigid(matrix: ArrayLike, *, tolerance: float = 1e-3) -> bool:
    """Whether a [4, 4] matrix is a finite rigid transform: rotation, shift, row [0, 0, 0, 1]."""
    m = np.asarray(matrix, dtype=np.float64)
    return m.shape == (4, 4) and bool(are_rigid(m, tolerance=tolerance))


def are_rigid(matrices: ArrayLike, *, tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Which of [..., 4, 4] matrices are rigid transforms, [...] bool; like :func:`is_rigid`."""
    m = np.asarray(matrices, dtype=np.float64)
    last_row = np.abs(m[..., 3, :] - [0, 0, 0, 1]).max(axis=-1) < tolerance
    shift = np.isfinite(m[..., :3, 3]).all(axis=-1)
    return np.asarray(last_row & shift & are_rotations(m[..., :3, :3], tolerance=tolerance))
