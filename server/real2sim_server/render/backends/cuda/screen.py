"""Sizes and gradients on the image as gsplat knows them."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ...types import ScreenStatistics
from ..base import RasterRequest
from ..screen import empty_statistics, screen_scale


@dataclass(frozen=True, eq=False)
class GsplatStatistics(ScreenStatistics):
    """Keeps gsplat's centres alive, on which it leaves the absolute gradients."""

    means2d: Tensor | None = None


def track_screen(
    request: RasterRequest, meta: dict[str, Any] | None, device: torch.device
) -> ScreenStatistics:
    """Statistics on the device: radii at once, gradients when backward comes by.

    Args:
        meta: what ``gsplat.rasterization(packed=True, absgrad=True)`` returned last; None where
            there was nothing to draw.
    """
    empty = empty_statistics(request, device)
    if meta is None:
        return empty
    means2d: Tensor = meta["means2d"]
    statistics = GsplatStatistics(empty.radii, empty.gradients, means2d)
    counts = torch.tensor([len(radii[0]) for radii in empty.radii], device=device)
    ends = counts.cumsum(0)
    gaussians, cameras = meta["gaussian_ids"].long(), meta["camera_ids"].long()
    owners = torch.bucketize(gaussians, ends, right=True)
    members = gaussians - (ends - counts)[owners]
    radii = meta["radii"].amax(-1).float()
    for index, held in enumerate(statistics.radii):
        mine = owners == index
        held[cameras[mine], members[mine]] = radii[mine]
    if not means2d.requires_grad:
        return statistics

    # The hook lives on the centres and would keep them alive for ever if it held them.
    held_weakly = weakref.ref(statistics)
    scale = torch.tensor(screen_scale(request), device=device)

    def add(gradient: Tensor) -> None:
        kept = held_weakly()
        if kept is None or kept.means2d is None:
            return
        both = torch.stack([gradient, kept.means2d.absgrad], dim=1) * scale  # type: ignore[attr-defined]
        norms = both.norm(dim=-1)
        for index, sums in enumerate(kept.gradients):
            mine = owners == index
            sums.index_add_(0, members[mine], norms[mine])

    means2d.register_hook(add)
    return statistics
