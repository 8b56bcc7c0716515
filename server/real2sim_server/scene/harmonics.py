"""Real spherical harmonics of splats: basis and rotation, degree 0 to 3.

Basis order and signs are those of 3D Gaussian Splatting (Kerbl et al. 2023), which every splat
file uses.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..geometry.rotation import Float

SH_C0 = 0.28209479177387814
"""The constant basis function: colour = SH_C0 * sh[0] + 0.5."""

MAX_DEGREE = 3


def sh_basis(directions: Float, degree: int) -> Float:
    """Basis functions [..., (degree + 1)^2] float64 at unit ``directions`` [..., 3]."""
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    functions = [
        np.full_like(x, SH_C0),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(functions[: (degree + 1) ** 2], axis=-1)


def sh_rotation(rotation: Float, degree: int) -> Float:
    """Matrix [K, K] float64 that turns SH coefficients along with ``rotation`` [3, 3].

    The turned function at R d equals the original at d. Each band is closed under rotation, so the
    matrix is block-diagonal; a block is the exact solution of an overdetermined linear system over
    fixed directions.
    """
    directions = _spread_directions()
    before = sh_basis(directions, degree)
    after = sh_basis(directions @ np.asarray(rotation, dtype=np.float64).T, degree)
    matrix = np.zeros((before.shape[1], before.shape[1]))
    for band in range(degree + 1):
        part = slice(band * band, (band + 1) ** 2)
        matrix[part, part] = np.linalg.lstsq(after[:, part], before[:, part], rcond=None)[0]
    # Rounding noise, which would make turning by nothing change bits.
    matrix[np.abs(matrix) < 1e-12] = 0
    return matrix


def rotate_sh(sh: Tensor, rotation: Float) -> Tensor:
    """Coefficients [N, K, 3] of the same Gaussians after turning them by ``rotation`` [3, 3]."""
    if sh.shape[1] == 1:
        return sh
    degree = round(sh.shape[1] ** 0.5) - 1
    matrix = torch.from_numpy(sh_rotation(rotation, degree)).to(sh)
    return torch.einsum("jk,nkc->njc", matrix, sh).contiguous()


def _spread_directions(count: int = 64) -> Float:
    """Unit directions [count, 3] spread evenly (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    radius = np.sqrt(1 - z * z)
    angle = np.pi * (1 + 5**0.5) * k
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
