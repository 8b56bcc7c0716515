"""Clusters of 3D Gaussians: spherical harmonics, transforms, and colour that changes over time."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ..geometry import Float, is_rigid, matrix_to_quaternion, quaternion_to_matrix
from .errors import SceneError

# Real spherical harmonics, degree 0 to 3. Basis order and signs are those of 3D Gaussian Splatting
# (Kerbl et al. 2023), which every splat file uses; the formulas are in Sloan, Stupid Spherical
# Harmonics Tricks (2008).

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
    """Matrix [K, K] float64 that rotates SH coefficients by ``rotation`` [3, 3].

    The rotated function at R d equals the original at d. Each band is closed under rotation, so the
    matrix is block-diagonal. A block is the exact solution of an overdetermined linear system over
    fixed directions.
    """
    directions = _spread_directions()
    before = sh_basis(directions, degree)
    after = sh_basis(directions @ np.asarray(rotation, dtype=np.float64).T, degree)
    matrix = np.zeros((before.shape[1], before.shape[1]))
    for band in range(degree + 1):
        part = slice(band * band, (band + 1) ** 2)
        matrix[part, part] = np.linalg.lstsq(after[:, part], before[:, part], rcond=None)[0]
    # Without rounding noise, the identity rotation changes no bits.
    matrix[np.abs(matrix) < 1e-12] = 0
    return matrix


def rotate_sh(sh: Tensor, rotation: Float) -> Tensor:
    """Coefficients [N, K, 3] of the same Gaussians after ``rotation`` [3, 3]."""
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


SH_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
UNSEEN = 0.25
"""Uncertainty without training rays: roughly the absolute error of a guessed colour."""


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
            own frame, the basis of :func:`.sh_basis`.
        uncertainties: [N] float32 in [0, 1], expected absolute error of the colour, UNSEEN for
            Gaussians without training rays; None if unknown.

    Raises:
        SceneError: shapes do not match, a dtype is not float32, or tensors are on different
            devices. Values are not checked; use :meth:`check_values`.
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
        """The tensors by name, without absent ones."""
        named = ((field.name, getattr(self, field.name)) for field in fields(self))
        return {name: tensor for name, tensor in named if tensor is not None}

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return SH_DEGREES[int(self.sh.shape[1])]

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
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
        """The cloud on another device; itself if it is already there."""
        if torch.device(device) == self.device:
            return self
        return GaussianCloud(**{name: t.to(device) for name, t in self.tensors().items()})

    def select(self, index: Tensor) -> GaussianCloud:
        """The Gaussians selected by a mask [N] bool or indices [M] int64."""
        return GaussianCloud(**{name: t[index].contiguous() for name, t in self.tensors().items()})

    def by_importance(self) -> Tensor:
        """Indices [N] int64, largest coverage first: by opacity times the area [m^2] of the largest
        ellipse. The sort is stable.
        """
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
        """The same Gaussians with uncertainties, UNSEEN if unknown."""
        if self.uncertainties is not None:
            return self
        return replace(self, uncertainties=torch.full_like(self.opacities, UNSEEN))

    def moved(self, T_dst_src: ArrayLike, *, scale: float = 1.0) -> GaussianCloud:
        """The Gaussians in another frame: scaled about the origin, then placed by ``T_dst_src``.

        The spherical harmonics are rotated too, so that the cloud looks the same from every side.

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
        """The Gaussians scaled about the origin along the axes of their frame; colours keep their
        directions.

        Args:
            factors: factors along x, y and z, > 0.

        Raises:
            SceneError: a factor is not positive.
        """
        if not all(np.isfinite(f) and f > 0 for f in factors):
            raise SceneError(f"factors of a cloud must be positive, not {factors}")
        by = torch.tensor(factors, dtype=torch.float64, device=self.device)
        turns = torch.from_numpy(quaternion_to_matrix(self.quats.cpu().numpy())).to(self.device)
        # Columns are the scaled axes of each ellipsoid; its covariance is axes axes^T.
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
        """Check every value of a cloud from an untrusted source.

        Args:
            what: name of the cloud for the message.

        Raises:
            SceneError: values are not finite, scales not positive, opacities or uncertainties
                outside
                [0, 1], or quaternions not of unit length, each with the count.
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

        If only some clouds have uncertainties, the others get UNSEEN.
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


# Colour that changes over time.

BASES = ("cosine", "real_dft")


@dataclass(frozen=True, eq=False)
class TimeColour:
    """Time-dependent offset of the constant part of a cloud's colour.

    The phase s goes from 0 at ``start_us`` to 1 at ``end_us`` and is clamped outside. The SH
    coefficient ``sh[:, 0]`` becomes ``sh[:, 0] + sum_k coefficients[:, k] b_k(s)``, k from 0.

    Attributes:
        coefficients: [N, F, 3] float32.
        basis: ``cosine``: b_k = cos(pi (k + 1) s), half periods, so that beginning and end may
            differ (Yan et al. 2024, eq. 4); ``real_dft``: sin(2 pi s), cos(2 pi s), sin(4 pi s)
            ..., as in their released code.
        start_us, end_us: [us], start before end.

    Raises:
        SceneError: wrong shapes, an unknown basis or an empty time span.
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
        """Values [M, F] at several times [us]; each row equals :meth:`tones`."""
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
    """Values [count] float32 of the basis functions at ``phase``, clamped to [0, 1]."""
    return torch.from_numpy(_values_at(phase, count, basis).copy())


@lru_cache(maxsize=1024)
def _values_at(phase: float, count: int, basis: str) -> NDArray[np.float32]:
    """Cached per phase: the objects of a scene mostly share the time span of their colours."""
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
