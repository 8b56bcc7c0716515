"""A cluster of 3D Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from .errors import SceneError

SH_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}


@dataclass(frozen=True, eq=False)
class GaussianCloud:
    """Immutable Gaussians in one frame, with activated parameters (linear scales, alpha in [0, 1]).

    Attributes:
        means: [N, 3] float32, centres in the cloud's frame [m].
        quats: [N, 4] float32, wxyz, unit.
        scales: [N, 3] float32, standard deviations along the Gaussian's own axes [m], > 0.
        opacities: [N] float32 in [0, 1].
        sh: [N, K, 3] float32, spherical harmonics, K = (degree + 1)^2, degree 0 to 3; RGB is
            ``clamp(sum_k sh_k Y_k(direction) + 0.5, min=0)`` with the direction in the cloud's
            own frame.

    Raises:
        SceneError: on shapes that do not fit together or a dtype other than float32.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        for name, shape in expected.items():
            given = tuple(getattr(self, name).shape)
            if given != shape:
                raise SceneError(f"{name} of a cloud of {n} Gaussians must be {shape}, not {given}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[2] != 3:
            raise SceneError(f"sh of a cloud of {n} Gaussians must be ({n}, K, 3), not {tuple(self.sh.shape)}")
        if self.sh.shape[1] not in SH_DEGREES:
            raise SceneError(f"sh has {self.sh.shape[1]} bands; allowed are {sorted(SH_DEGREES)}")
        for field in fields(self):
            dtype = getattr(self, field.name).dtype
            if dtype != torch.float32:
                raise SceneError(f"{field.name} of a cloud must be float32, not {dtype}")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return SH_DEGREES[int(self.sh.shape[1])]

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        return self.means.device

    @property
    def nbytes(self) -> int:
        """Memory of all tensors [bytes]."""
        return sum(
            getattr(self, f.name).numel() * getattr(self, f.name).element_size() for f in fields(self)
        )

    @classmethod
    def empty(cls, *, sh_degree: int = 0) -> GaussianCloud:
        """A cloud without Gaussians."""
        k = (sh_degree + 1) ** 2
        return cls(
            torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, k, 3)
        )

    def to(self, device: torch.device | str) -> GaussianCloud:
        """The cloud on another device; itself when it is there already."""
        if torch.device(device) == self.device:
            return self
        return GaussianCloud(*(getattr(self, f.name).to(device) for f in fields(self)))

    def select(self, index: Tensor) -> GaussianCloud:
        """The Gaussians picked by a mask [N] bool or indices [M] int64."""
        return GaussianCloud(*(getattr(self, f.name)[index].contiguous() for f in fields(self)))

    def with_sh_degree(self, degree: int) -> GaussianCloud:
        """The same Gaussians with SH padded by zeros, or cut, to ``degree``."""
        k = (degree + 1) ** 2
        if k == self.sh.shape[1]:
            return self
        sh = torch.zeros(len(self), k, 3, device=self.device)
        kept = min(k, int(self.sh.shape[1]))
        sh[:, :kept] = self.sh[:, :kept]
        return replace(self, sh=sh)

    @staticmethod
    def concatenate(clouds: list[GaussianCloud]) -> GaussianCloud:
        """All Gaussians of ``clouds`` (same frame, same device) in one, at the highest SH degree."""
        if not clouds:
            return GaussianCloud.empty()
        degree = max(c.sh_degree for c in clouds)
        padded = [c.with_sh_degree(degree) for c in clouds]
        return GaussianCloud(
            *(torch.cat([getattr(c, f.name) for c in padded]) for f in fields(GaussianCloud))
        )
