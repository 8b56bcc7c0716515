"""A cluster of 3D Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..geometry.transform import is_rigid, matrix_to_quaternion, quaternion_to_matrix
from .errors import SceneError
from .spherical_harmonics import rotate_sh

SH_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
UNSEEN = 0.25
"""Uncertainty of what no training ray has met: about the absolute error of a guessed colour."""


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
            own frame, the basis of :func:`~.spherical_harmonics.sh_basis`.
        uncertainties: [N] float32 in [0, 1], expected absolute error of the colour where training
            rays tell it, UNSEEN where none does; None where it is not known.

    Raises:
        SceneError: on shapes that do not fit together, a dtype other than float32, or tensors on
            different devices. Values are not looked at; :meth:`check_values` does that.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    uncertainties: Tensor | None = None

    def __post_init__(self) -> None:
        if self.means.ndim != 2:
            raise SceneError(f"means must be [N, 3], not {list(self.means.shape)}")
        n = self.means.shape[0]
        expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        expected["uncertainties"] = (n,)
        parts = self.tensors()
        for name, shape in expected.items():
            given = tuple(parts[name].shape) if name in parts else shape
            if given != shape:
                raise SceneError(f"{name} of a cloud of {n} Gaussians must be {shape}, not {given}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[2] != 3:
            raise SceneError(
                f"sh of a cloud of {n} Gaussians must be ({n}, K, 3), not {tuple(self.sh.shape)}"
            )
        if self.sh.shape[1] not in SH_DEGREES:
            raise SceneError(
                f"sh has {self.sh.shape[1]} coefficients; allowed are {sorted(SH_DEGREES)}"
            )
        for name, tensor in parts.items():
            if tensor.dtype != torch.float32:
                raise SceneError(f"{name} of a cloud must be float32, not {tensor.dtype}")
            if tensor.device != self.means.device:
                raise SceneError(
                    f"{name} is on {tensor.device}, means are on {self.means.device}; "
                    "a cloud lives on one device"
                )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def tensors(self) -> dict[str, Tensor]:
        """Its tensors by name, without what is not known."""
        named = ((field.name, getattr(self, field.name)) for field in fields(self))
        return {name: tensor for name, tensor in named if tensor is not None}

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
        return sum(tensor.numel() * tensor.element_size() for tensor in self.tensors().values())

    @classmethod
    def empty(cls, *, sh_degree: int = 0) -> GaussianCloud:
        """A cloud without Gaussians."""
        k = (sh_degree + 1) ** 2
        return cls(
            torch.zeros(0, 3),
            torch.zeros(0, 4),
            torch.zeros(0, 3),
            torch.zeros(0),
            torch.zeros(0, k, 3),
        )

    def to(self, device: torch.device | str) -> GaussianCloud:
        """The cloud on another device; itself when it is there already."""
        if torch.device(device) == self.device:
            return self
        return GaussianCloud(**{name: t.to(device) for name, t in self.tensors().items()})

    def select(self, index: Tensor) -> GaussianCloud:
        """The Gaussians picked by a mask [N] bool or indices [M] int64."""
        return GaussianCloud(**{name: t[index].contiguous() for name, t in self.tensors().items()})

    def by_importance(self) -> Tensor:
        """Indices [N] int64, what covers most first: by opacity times the area [m^2] of the
        largest ellipse; equals keep their order."""
        largest = self.scales.sort(dim=1, descending=True).values[:, :2]
        return torch.argsort(self.opacities * largest.prod(dim=1), descending=True, stable=True)

    def with_sh_degree(self, degree: int) -> GaussianCloud:
        """The same Gaussians with SH padded by zeros, or cut, to ``degree``."""
        k = (degree + 1) ** 2
        if k == self.sh.shape[1]:
            return self
        sh = torch.zeros(len(self), k, 3, device=self.device)
        kept = min(k, int(self.sh.shape[1]))
        sh[:, :kept] = self.sh[:, :kept]
        return replace(self, sh=sh)

    def with_uncertainties(self) -> GaussianCloud:
        """The same Gaussians with uncertainties: their own, or UNSEEN where none are known."""
        if self.uncertainties is not None:
            return self
        return replace(self, uncertainties=torch.full_like(self.opacities, UNSEEN))

    def moved(self, T_dst_src: ArrayLike, *, scale: float = 1.0) -> GaussianCloud:
        """The Gaussians in another frame: scaled about the origin, then placed by ``T_dst_src``.

        Turns the spherical harmonics too, so that the cloud looks the same from every side.

        Args:
            T_dst_src: [4, 4] rigid transform from this cloud's frame to the new one.
            scale: factor on positions and sizes, > 0.

        Raises:
            SceneError: for a transform that is not rigid or a scale that is not positive.
        """
        matrix = np.asarray(T_dst_src, dtype=np.float64)
        if not is_rigid(matrix):
            raise SceneError(f"T_dst_src must be a rigid [4, 4] transform, not {matrix.tolist()}")
        if not (np.isfinite(scale) and scale > 0):
            raise SceneError(f"scale of a cloud must be positive, not {scale}")
        turn = torch.from_numpy(matrix_to_quaternion(matrix[:3, :3])).to(self.device)
        placed = torch.from_numpy(matrix).to(self.device)
        means = (self.means.double() * scale) @ placed[:3, :3].T + placed[:3, 3]
        return GaussianCloud(
            means.float(),
            _hamilton(turn, self.quats.double()).float(),
            self.scales * scale,
            self.opacities,
            rotate_sh(self.sh, matrix[:3, :3]),
            self.uncertainties,
        )

    def stretched(self, factors: tuple[float, float, float]) -> GaussianCloud:
        """The Gaussians multiplied about the origin along the axes of their frame; colours keep
        their directions.

        Args:
            factors: of x, y and z, > 0.

        Raises:
            SceneError: for a factor that is not positive.
        """
        if not all(np.isfinite(f) and f > 0 for f in factors):
            raise SceneError(f"factors of a cloud must be positive, not {factors}")
        by = torch.tensor(factors, dtype=torch.float64, device=self.device)
        turns = torch.from_numpy(quaternion_to_matrix(self.quats.cpu().numpy())).to(self.device)
        # Columns: the axes of each ellipsoid, as long as it is; its covariance is axes axes^T.
        axes = by[:, None] * turns * self.scales.double()[:, None, :]
        variances, vectors = torch.linalg.eigh(axes @ axes.transpose(1, 2))
        vectors = vectors * torch.linalg.det(vectors).sign()[:, None, None]
        quats = torch.from_numpy(matrix_to_quaternion(vectors.cpu().numpy())).to(self.device)
        return replace(
            self,
            means=(self.means.double() * by).float(),
            quats=quats.float(),
            scales=variances.clamp(min=1e-16).sqrt().float(),
        )

    def check_values(self, what: str) -> None:
        """Look at every value, as is due where a cloud comes from outside.

        Args:
            what: name of the cloud for the message.

        Raises:
            SceneError: values that are not finite, scales not positive, opacities or uncertainties
                outside [0, 1] or quaternions that are not unit length, each with the count.
        """
        parts = self.tensors()
        for name, tensor in parts.items():
            _refuse(~torch.isfinite(tensor), what, f"{name} not finite")
        _refuse(self.scales <= 0, what, "scales not positive")
        for name in ("opacities", "uncertainties"):
            if name in parts:
                _refuse((parts[name] < 0) | (parts[name] > 1), what, f"{name} outside [0, 1]")
        _refuse((self.quats.norm(dim=-1) - 1).abs() > 1e-3, what, "quats not of unit length")

    @staticmethod
    def concatenate(clouds: list[GaussianCloud]) -> GaussianCloud:
        """All Gaussians of ``clouds`` (one frame, one device) in one, at the highest SH degree.

        Where only some have uncertainties, those of the others are UNSEEN.
        """
        if not clouds:
            return GaussianCloud.empty()
        degree = max(c.sh_degree for c in clouds)
        padded = [c.with_sh_degree(degree) for c in clouds]
        if any(c.uncertainties is not None for c in padded):
            padded = [c.with_uncertainties() for c in padded]
        parts = [c.tensors() for c in padded]
        return GaussianCloud(**{name: torch.cat([p[name] for p in parts]) for name in parts[0]})


def _hamilton(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product [N, 4] of one wxyz quaternion [4] with many [N, 4]."""
    w, x, y, z = left.tolist()
    matrix = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return right @ torch.tensor(matrix, dtype=right.dtype, device=right.device).T


def _refuse(bad: Tensor, what: str, reason: str) -> None:
    count = int(bad.sum())
    if count:
        raise SceneError(f"{what}: {count} of {bad.numel()} values: {reason}")
