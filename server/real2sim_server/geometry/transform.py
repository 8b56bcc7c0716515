"""Rigid transforms in float64 NumPy: ``T_dst_src`` is [4, 4] and maps src coordinates to dst."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .rotation import Float, are_rotations, quaternion_to_matrix


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
