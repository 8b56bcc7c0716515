"""Embedding of Gaussians in a body of particles: each Gaussian follows the particles around it.

The map of a Gaussian is the weighted least-squares affine fit to the motion of its nearest
particles (moving least squares). The fit is linear in particle displacements, so its coefficients
are computed once. It reproduces affine motions of the particles exactly.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry.transform import Float, matrix_to_quaternion, quaternion_to_matrix
from ..scene import GaussianCloud
from ..scene.cloud import sh_basis

NEIGHBOURS = 20
FLAT = 0.05
"""Second moments below this times spacing^2 say nothing about the gradient along their axis."""
STRETCH_LIMITS = (0.2, 2.0)
"""Stretch limits of a Gaussian, so that it does not become a sheet across a tear."""
TURNED = 1e-3
"""Smallest rotation, as matrix entry, for which colours are turned."""


@dataclass(frozen=True, eq=False)
class Deformed:
    """Maps of G Gaussians: positions [G, 3] [m], F [G, 3, 3], its rotation part [G, 3, 3]."""

    positions: Float
    F: Float
    rotations: Float


class Embedding:
    """Points in a solid of particles at rest.

    Args:
        rest: [N, 3] particles at rest [m].
        points: [G, 3] points in the same frame [m].
        spacing: distance of particles [m].
    """

    def __init__(self, rest: Float, points: Float, *, spacing: float) -> None:
        from scipy.spatial import cKDTree

        count = min(NEIGHBOURS, len(rest))
        distance, index = cKDTree(rest).query(points, k=count)
        distance, index = distance.reshape(-1, count), index.reshape(-1, count)
        reach = np.maximum(2.0 * spacing, 1.6 * distance[:, [min(4, count - 1)]])
        weights = np.maximum(1 - (distance / reach) ** 2, 0) ** 2 + 1e-9
        weights /= weights.sum(axis=1, keepdims=True)
        self._index: NDArray[np.int64] = index
        self._weights = weights
        # Batched products of small matrices: einsum is several times slower.
        centre = (weights[:, None] @ rest[index])[:, 0]
        r = rest[index] - centre[:, None]
        weighted = weights[:, :, None] * r
        second = r.transpose(0, 2, 1) @ weighted
        value, axes = np.linalg.eigh(second)
        solid = value > FLAT * spacing**2
        inverted = np.where(solid, 1 / np.maximum(value, 1e-12), 0)
        inverse = (axes * inverted[:, None]) @ axes.transpose(0, 2, 1)
        self._slopes = weighted @ inverse
        self._centre = centre
        self._offset = points - centre
        # Far from all particles, only use the rotation.
        beyond = np.linalg.norm(self._offset, axis=1) / spacing
        self._trust = np.clip(2.5 - beyond, 0, 1)[:, None, None]

    def near(self, particles: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """[G] whether points follow any of the particles [N]."""
        found: NDArray[np.bool_] = np.any(particles[self._index], axis=1)
        return found

    def gradients(self, displacements: Float, rows: NDArray[np.int64]) -> Float:
        """[R, 3, 3] F of some points, without stretch limits; much faster than :meth:`follow`."""
        u = np.asarray(displacements, dtype=np.float64)[self._index[rows]]
        trust = self._trust[rows]
        F: Float = np.eye(3) + trust * (u.transpose(0, 2, 1) @ self._slopes[rows])
        return F

    def follow(self, displacements: Float, rows: NDArray[np.int64] | None = None) -> Deformed:
        """Positions of the points under particle displacements [N, 3] [m].

        Args:
            displacements: displacements of all particles.
            rows: indices of the points; all by default.
        """
        if rows is not None:
            return self._of(rows).follow(displacements)
        u = np.asarray(displacements, dtype=np.float64)[self._index]
        F = np.eye(3) + u.transpose(0, 2, 1) @ self._slopes
        left, stretch, right = np.linalg.svd(F)
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        rotations = left @ right
        clamped = (left * np.clip(stretch, *STRETCH_LIMITS)[:, None, :]) @ right
        F = self._trust * clamped + (1 - self._trust) * rotations
        mean = (self._weights[:, None] @ u)[:, 0]
        moved = self._centre + mean + (F @ self._offset[:, :, None])[:, :, 0]
        return Deformed(moved, F, rotations)

    def _of(self, rows: NDArray[np.int64]) -> Embedding:
        """The embedding of a subset of points."""
        part = copy(self)
        for name in ("_index", "_weights", "_slopes", "_centre", "_offset", "_trust"):
            setattr(part, name, getattr(self, name)[rows])
        return part


def deform_cloud(cloud: GaussianCloud, deformed: Deformed) -> GaussianCloud:
    """The deformed Gaussians: mean, covariance F S F^T, colours rotated by the rotation part of F.

    Opacities and uncertainties are unchanged. Covariances are decomposed into unit quaternions and
    scales again.
    """
    axes = quaternion_to_matrix(cloud.quats.detach().cpu().numpy())
    scales = cloud.scales.detach().cpu().numpy().astype(np.float64)
    left, stretch, _ = np.linalg.svd(deformed.F @ (axes * scales[:, None, :]))
    left[:, :, 2] *= np.sign(np.linalg.det(left))[:, None]
    return replace(
        cloud,
        means=_tensor(deformed.positions, cloud),
        quats=_tensor(matrix_to_quaternion(left), cloud),
        scales=_tensor(stretch, cloud),
        sh=_turned(cloud, deformed.rotations),
    )


def replaced_rows(cloud: GaussianCloud, rows: torch.Tensor, part: GaussianCloud) -> GaussianCloud:
    """The cloud with ``rows`` [P] int64 replaced by ``part``.

    Opacities and uncertainties are unchanged.
    """

    def replaced(name: str) -> torch.Tensor:
        values: torch.Tensor = getattr(cloud, name).detach().clone()
        values[rows] = getattr(part, name)
        return values

    means, quats, scales, sh = (replaced(name) for name in ("means", "quats", "scales", "sh"))
    return replace(cloud, means=means, quats=quats, scales=scales, sh=sh)


def stretched(cloud: GaussianCloud, factors: tuple[float, float, float]) -> GaussianCloud:
    """The cloud scaled by ``factors`` along its frame's axes, as an edit's scale does."""
    if factors == (1.0, 1.0, 1.0):
        return cloud
    F = np.tile(np.diag(np.asarray(factors, dtype=np.float64)), (len(cloud), 1, 1))
    means = cloud.means.detach().cpu().numpy().astype(np.float64)
    return deform_cloud(cloud, Deformed(means * factors, F, np.tile(np.eye(3), (len(cloud), 1, 1))))


def _tensor(values: Float, like: GaussianCloud) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32)).to(like.device)


def _turned(cloud: GaussianCloud, rotations: Float) -> torch.Tensor:
    """Spherical harmonics of each Gaussian, rotated by its own rotation."""
    degree = cloud.sh_degree
    turned = np.abs(rotations - np.eye(3)).max(axis=(1, 2)) > TURNED
    if degree == 0 or not turned.any():
        return cloud.sh
    index = np.flatnonzero(turned)
    sh = cloud.sh.detach().cpu().numpy().astype(np.float64)
    directions = _directions()
    # The turned function at R d is the old one at d: fit through fixed directions.
    before = sh_basis(directions, degree)
    turned_basis = sh_basis(directions @ rotations[index].transpose(0, 2, 1), degree)
    for band in range(1, degree + 1):
        part = slice(band * band, (band + 1) ** 2)
        after = turned_basis[..., part]
        own = before[:, part] @ sh[index][:, part]
        across = after.transpose(0, 2, 1)
        sh[index, part] = np.linalg.solve(across @ after, across @ own)
    return torch.from_numpy(sh.astype(np.float32)).to(cloud.device)


def _directions(count: int = 32) -> Float:
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    radius, angle = np.sqrt(1 - z * z), np.pi * (1 + 5**0.5) * k
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
