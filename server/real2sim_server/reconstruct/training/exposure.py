"""How much brighter or darker single images were taken than the rest."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class ImageGains:
    """Gains of the colours of every training image.

    Attributes:
        logarithms: [cameras * K, 3] natural logarithms of the gains of red, green and blue, 0 at
            first; by camera, in the order of the times.

    Args:
        cameras: how many there are.
        times_us: [K] int64 times of training images, in order.
        device: where they lie.
    """

    def __init__(
        self, cameras: int, times_us: NDArray[np.int64], *, device: torch.device | str = "cpu"
    ) -> None:
        self._times_us = times_us
        rows = cameras * len(times_us)
        self.logarithms = torch.zeros(rows, 3, device=device, requires_grad=True)

    def at(self, camera: int, t_us: int) -> Tensor:
        """Gains [3] of a camera at a time, between images in between; they carry gradients."""
        times, count = self._times_us, len(self._times_us)
        after = min(int(np.searchsorted(times, t_us)), count - 1)
        before = after if times[after] <= t_us else max(after - 1, 0)
        span = max(int(times[after] - times[before]), 1)
        share = min(max((t_us - int(times[before])) / span, 0.0), 1.0) if after > before else 0.0
        held = self.logarithms[camera * count : (camera + 1) * count]
        return (held[before] * (1 - share) + held[after] * share).exp()

    def squares(self) -> Tensor:
        """Sum over an image's gains of squared logarithms, mean over all images."""
        return self.logarithms.square().sum() / max(len(self.logarithms), 1)
