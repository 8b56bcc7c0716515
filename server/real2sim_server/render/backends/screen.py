"""Sizes and gradients on the image where torch itself differentiates, gathered by hooks."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from ..types import ScreenStatistics
from .base import RasterRequest


def empty_statistics(
    request: RasterRequest, device: torch.device | str = "cpu"
) -> ScreenStatistics:
    """Zeros for every Gaussian of every instance."""
    counts = [len(instance.cloud) for instance in request.instances]
    return ScreenStatistics(
        radii=tuple(torch.zeros(request.cameras, n, device=device) for n in counts),
        gradients=tuple(torch.zeros(n, 2, device=device) for n in counts),
    )


def screen_scale(request: RasterRequest) -> tuple[float, float]:
    """Factors on gradients by x and y [px]; see ScreenStatistics."""
    return request.cameras * request.width / 2, request.cameras * request.height / 2


class ScreenTracker:
    """Fills ScreenStatistics for the reference."""

    def __init__(self, request: RasterRequest) -> None:
        self.statistics = empty_statistics(request)
        self._scale = torch.tensor(screen_scale(request), dtype=torch.float64)
        self._size = torch.tensor([request.width, request.height])

    def watch(
        self, camera: int, owners: Tensor, means2d: Tensor, extents: Tensor
    ) -> ScreenWatch | None:
        """Note the radii of V splats of one camera and listen for the gradients of their centres.

        Args:
            camera: index of the camera.
            owners: [V, 2] int64, instance and Gaussian of each splat.
            means2d: [V, 2] centres [px].
            extents: [V, 2] half the sides of their boxes [px].
        """
        centres = means2d.detach()
        seen = ((centres + extents > 0) & (centres - extents < self._size)).all(-1)
        radii = torch.where(seen, extents.amax(-1).ceil(), 0.0).float()
        for index, held in enumerate(self.statistics.radii):
            mine = owners[:, 0] == index
            held[camera, owners[mine, 1]] = radii[mine]
        if not means2d.requires_grad:
            return None
        watch = ScreenWatch(len(owners))
        means2d.register_hook(lambda gradient: self._add(owners, gradient, watch))
        return watch

    def _add(self, owners: Tensor, gradient: Tensor, watch: ScreenWatch) -> None:
        both = torch.stack([gradient, watch.absolute], dim=1) * self._scale
        norms = both.norm(dim=-1).float()
        watch.absolute.zero_()
        for index, held in enumerate(self.statistics.gradients):
            mine = owners[:, 0] == index
            held[owners[mine, 1]] += norms[mine]


class ScreenWatch:
    """Sums over pixels of absolute gradients [V, 2] by the centres of V splats of one camera."""

    def __init__(self, count: int) -> None:
        self.absolute = torch.zeros(count, 2, dtype=torch.float64)

    def gather(self, index: Tensor, dx: Tensor, dy: Tensor) -> None:
        """Listen to offsets [M, pixels] from the splats ``index`` [M] to the pixels of a tile."""
        for axis, offsets in enumerate((dx, dy)):
            if offsets.requires_grad:
                offsets.register_hook(functools.partial(self._add, axis, index))

    def _add(self, axis: int, index: Tensor, gradient: Tensor) -> None:
        self.absolute[:, axis].index_add_(0, index, gradient.abs().sum(1).double())
