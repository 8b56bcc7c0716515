"""Blending from front to back in plain torch: one twin for splats on a plane and along rays."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from .base import TRANSMITTANCE_MIN


class Blended(Protocol):
    """N splats from front to back."""

    @property
    def colors(self) -> Tensor:
        """[N, 3]."""
        ...

    @property
    def depths(self) -> Tensor:
        """[N] [m]."""
        ...

    @property
    def instance_ids(self) -> Tensor:
        """[N]."""
        ...


def blend(splats: Blended, alpha: Tensor, size: tuple[int, ...]) -> tuple[Tensor, ...]:
    """Colour [*size, 3], opacity, depth, instance and median depth [*size] of pixels.

    Args:
        splats: N of them, from front to back.
        alpha: [N, pixels], of each at each pixel.
        size: of the image of these pixels.
    """
    dtype = alpha.dtype
    after = torch.cumprod(1 - alpha, dim=0)
    alpha = torch.where(after > TRANSMITTANCE_MIN, alpha, 0.0)
    after = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([torch.ones(1, after.shape[1], dtype=dtype), after[:-1]])[: len(after)]
    weights = alpha * before
    total = 1 - torch.prod(1 - alpha, dim=0)
    rgb = weights.mT @ splats.colors
    depth = (weights.mT @ splats.depths) / torch.where(total > 0, total, 1.0)

    crossing = (before > 0.5) & (after <= 0.5)
    instance = (crossing * splats.instance_ids[:, None]).sum(0)
    median = (crossing * splats.depths.detach()[:, None]).sum(0)
    rest = (image.reshape(size) for image in (total, depth, instance, median))
    return rgb.reshape(*size, 3), *rest
