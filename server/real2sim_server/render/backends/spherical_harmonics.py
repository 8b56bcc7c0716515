"""Real spherical harmonics of degree 0 to 3 in torch (Sloan 2013), as in 3D Gaussian splatting."""

from __future__ import annotations

import torch
from torch import Tensor


def evaluate_sh(sh: Tensor, directions: Tensor) -> Tensor:
    """Sum of ``sh`` [N, K, 3] along ``directions`` [N, 3] (any length), K = (degree + 1)^2.

    Returns:
        [N, 3], without the offset of 0.5 and without clamping.
    """
    basis = sh_basis(torch.nn.functional.normalize(directions, dim=-1), int(sh.shape[1]))
    return (basis[:, :, None] * sh).sum(1)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """The first ``count`` (1, 4, 9 or 16) basis functions [N, count] at unit ``directions``."""
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
