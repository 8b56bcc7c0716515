"""3D Gaussian Splatting as Markov chain Monte Carlo (Kheradmand et al. 2024): relocation."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

MAX_COPIES = 51


def sample_by_weight(weights: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """``count`` indices [count] int64 drawn with probability proportional to ``weights`` [N]."""
    sums = np.cumsum(weights.double().numpy())
    chosen = np.searchsorted(sums, rng.random(count) * sums[-1], side="right")
    return torch.from_numpy(np.minimum(chosen, len(sums) - 1))


def compute_relocation(
    opacities: Tensor, copies: Tensor, min_opacity: float
) -> tuple[Tensor, Tensor]:
    """Opacity [M] of each of ``copies`` [M] that look together like one, and factor on its size.

    Kheradmand et al. 2024, eq. 9.
    """
    n = copies.clamp(max=MAX_COPIES)
    opacities = opacities.clamp(max=1 - 1e-6).double()
    each = 1 - (1 - opacities) ** (1 / n)
    total = torch.zeros_like(each)
    for i in range(1, int(n.max()) + 1 if len(n) else 1):
        inner = torch.zeros_like(each)
        for k in range(i):
            inner += math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * each ** (k + 1)
        total += torch.where(i <= n, inner, 0.0)
    factor = opacities / total
    return each.clamp(min_opacity, 1 - 1e-6).float(), factor.float()
