"""Colour that changes over time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .cloud import GaussianCloud
from .errors import SceneError

BASES = ("cosine", "real_dft")


@dataclass(frozen=True, eq=False)
class TimeColour:
    """What is added to the constant part of a cloud's colour as time goes by.

    At phase s, which goes from 0 at ``start_us`` to 1 at ``end_us`` and stays there, the SH
    coefficient ``sh[:, 0]`` becomes ``sh[:, 0] + sum_k coefficients[:, k] b_k(s)``, k from 0.

    Attributes:
        coefficients: [N, F, 3] float32.
        basis: ``cosine``: b_k = cos(pi (k + 1) s), half periods, so that beginning and end may
            differ (Yan et al. 2024, eq. 4); ``real_dft``: sin(2 pi s), cos(2 pi s), sin(4 pi s)
            ..., as their released code has it.
        start_us, end_us: [us], start before end.

    Raises:
        SceneError: for other shapes, an unknown basis or an empty span of time.
    """

    coefficients: Tensor
    basis: str
    start_us: int
    end_us: int

    def __post_init__(self) -> None:
        shape = tuple(self.coefficients.shape)
        if len(shape) != 3 or shape[2] != 3 or self.coefficients.dtype != torch.float32:
            raise SceneError(f"colour coefficients must be [N, F, 3] float32, not {shape}")
        if self.basis not in BASES:
            raise SceneError(f"basis of a colour must be one of {list(BASES)}, not {self.basis!r}")
        if not self.start_us < self.end_us:
            raise SceneError(
                f"a colour must start before it ends, not {self.start_us} and {self.end_us}"
            )

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return self.coefficients.numel() * self.coefficients.element_size()

    def tones(self, t_us: int) -> Tensor:
        """Values [F] float32 of the basis functions at ``t_us``."""
        phase = (t_us - self.start_us) / (self.end_us - self.start_us)
        return colour_basis(phase, int(self.coefficients.shape[1]), self.basis)

    def tones_of(self, times_us: NDArray[np.int64]) -> NDArray[np.float32]:
        """Values [M, F] at many instants [us], each row as :meth:`tones` gives it."""
        phases = (times_us - self.start_us) / (self.end_us - self.start_us)
        return _basis_values(phases, int(self.coefficients.shape[1]), self.basis)

    def at(self, cloud: GaussianCloud, t_us: int) -> GaussianCloud:
        """``cloud`` with the colours of ``t_us``."""
        tones = self.tones(t_us).to(cloud.device)
        sh = cloud.sh.clone()
        sh[:, 0] += torch.einsum("nfc,f->nc", self.coefficients, tones)
        return replace(cloud, sh=sh)

    def to(self, device: torch.device | str) -> TimeColour:
        """The colour on another device."""
        return replace(self, coefficients=self.coefficients.to(device))


def colour_basis(phase: float, count: int, basis: str) -> Tensor:
    """Values [count] float32 of the basis functions at ``phase``, held to [0, 1]."""
    return torch.from_numpy(_values_at(phase, count, basis).copy())


@lru_cache(maxsize=1024)
def _values_at(phase: float, count: int, basis: str) -> NDArray[np.float32]:
    """Of one instant: the objects of a scene mostly have colours over the same span of time."""
    values: NDArray[np.float32] = _basis_values(np.array([phase]), count, basis)[0]
    return values


def _basis_values(phases: NDArray[np.float64], count: int, basis: str) -> NDArray[np.float32]:
    s = np.clip(phases, 0.0, 1.0)[:, None]
    k = np.arange(count)
    if basis == "cosine":
        values = np.cos(np.pi * (k + 1) * s)
    else:
        angle = 2 * np.pi * (k // 2 + 1) * s
        values = np.where(k % 2 == 0, np.sin(angle), np.cos(angle))
    return values.astype(np.float32)
