"""Real spherical harmonics of Gaussians, degree 0 to 3: basis, sum along directions, rotation.

Basis order and signs are those of 3D Gaussian Splatting (Kerbl et al. 2023), which every splat
file uses; the formulas are in Sloan, Stupid Spherical Harmonics Tricks (2008).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..geometry.transform import Float

SH_C0 = 0.28209479177387814
"""The constant basis function: colour = SH_C0 * sh[0] + 0.5."""


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


def evaluate_sh(sh: Tensor, directions: Tensor) -> Tensor:
    """Sum of ``sh`` [N, K, 3] along ``directions`` [N, 3] (any length), K = (degree + 1)^2.

    Returns:
        [N, 3], without the offset of 0.5 and without clamping.
    """
    basis = _tensor_basis(torch.nn.functional.normalize(directions, dim=-1), int(sh.shape[1]))
    return (basis[:, :, None] * sh).sum(1)


def _tensor_basis(directions: Tensor, count: int) -> Tensor:
    """The first ``count`` (1, 4, 9 or 16) functions [N, count], in the precision of the tensor."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, 0.2820947917738781)]
    if count > 1:
        basis += [-0.48860251190292 * y, 0.48860251190292 * z, -0.48860251190292 * x]
    if count > 4:
        basis += [
            1.092548430592079 * x * y,
            -1.092548430592079 * y * z,
            0.9461746957575601 * z * z - 0.3153915652525201,
            -1.092548430592079 * x * z,
            0.5462742152960395 * (x * x - y * y),
        ]
    if count > 9:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)


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
