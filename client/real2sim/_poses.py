"""Rigid poses as 4x4 matrices, and rotations as quaternions wxyz."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


def pose_matrix(position: Sequence[float], quaternion: Sequence[float]) -> Matrix:
    """[4, 4] of a position and a unit quaternion wxyz."""
    w, x, y, z = quaternion
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = position
    return pose


def quaternion_of(R: Matrix) -> tuple[float, float, float, float]:
    """wxyz of a rotation, by the largest eigenvector of Bar-Itzhack's matrix (2000).

    It is that of the rotation nearest to ``R``, so single precision does no harm.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    K = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    x, y, z, w = np.linalg.eigh(K)[1][:, -1].tolist()
    sign = -1.0 if w < 0 else 1.0
    return (sign * w, sign * x, sign * y, sign * z)


def pose_between(before: Matrix, after: Matrix, fraction: float) -> Matrix:
    """[4, 4] between two poses: positions linear, rotations along the shortest arc."""
    p, q = np.array(quaternion_of(before[:3, :3])), np.array(quaternion_of(after[:3, :3]))
    cosine = float(p @ q)
    q, cosine = (q, cosine) if cosine >= 0 else (-q, -cosine)
    angle = float(np.arccos(min(cosine, 1.0)))
    if angle < 1e-6:
        mixed = p + fraction * (q - p)
    else:
        mixed = np.sin((1 - fraction) * angle) * p + np.sin(fraction * angle) * q
    position = (1 - fraction) * before[:3, 3] + fraction * after[:3, 3]
    return pose_matrix(position.tolist(), (mixed / np.linalg.norm(mixed)).tolist())
