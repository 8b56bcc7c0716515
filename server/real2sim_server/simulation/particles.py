"""Particles of an object: filled from its Gaussians, and Gaussians that follow them."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from ..geometry import Float, matrix_to_quaternion, quaternion_to_matrix
from ..physics.body import Particles
from ..physics.errors import ParticleError
from ..physics.model import check_memory
from ..scene import GaussianCloud
from ..scene.cloud import sh_basis
from .structure import default_mass

# --- Embedding ------------------------------------------------------------------------------------

# Each Gaussian follows the particles around it. Its map is the weighted least-squares affine fit to
# the motion of its nearest particles (moving least squares). The fit is linear in particle
# displacements, so its coefficients are computed once. It reproduces affine motions exactly.

NEIGHBOURS = 20
FLAT = 0.05
"""Second moments below this times spacing^2 do not determine the gradient along their axis."""
STRETCH_LIMITS = (0.2, 2.0)
"""Stretch limits of a Gaussian; without them, it would become a sheet across a tear."""
TURNED = 1e-3
"""Minimum rotation, as a matrix entry, at which colours are rotated."""


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
        """[G] whether each point follows any of the particles [N]."""
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
    # The rotated function at R d equals the original at d: fit it at fixed directions.
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


# --- Filling --------------------------------------------------------------------------------------

# Voxels covered by Gaussians form the shell. Voxels reachable from outside along an axis without
# crossing the shell are outside; all others are inside. Sides that the recording hardly shows
# (typically the underside) are closed by the opposite side or the tracked box.

OPACITY_MIN = 0.05
"""Minimum opacity of Gaussians that become particles; fainter ones are haze."""
BOX_SLACK, BOX_SLACK_MAX = 0.1, 0.15
"""Gaussians outside the box by more than this fraction of its size, up to the second value [m], do
not belong to the object."""
SEEN_FRACTION = 0.5
"""Minimum fraction of its silhouette with a surface for a side to count as recorded."""
SAMPLES_MAX = 7
"""Maximum number of sample points along each axis of a Gaussian."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Filling:
    """A filled body, for inspection before the simulation.

    Attributes:
        particles: Gaussians and interior, object frame.
        shell, inside: [X, Y, Z] voxels.
        origin: [3] corner of voxel (0, 0, 0) [m].
        spacing: edge of a voxel [m].
        sealed: sides closed by the box, such as ``-z``.
    """

    particles: Particles
    shell: Mask
    inside: Mask
    origin: Float
    spacing: float
    sealed: tuple[str, ...]

    def lattice(self, *, above: float = -np.inf) -> Particles:
        """One particle at the centre of each voxel of the largest connected piece.

        A regular lattice makes a smoother solid than Gaussians, with fewer particles; the Gaussians
        follow it by :class:`Embedding`. The total mass is that of ``particles``.

        Args:
            above: omit voxels with centres below this height, object frame [m].
        """
        solid = self.shell | self.inside
        heights = self.origin[2] + (np.arange(solid.shape[2]) + 0.5) * self.spacing
        solid = solid & (heights >= above)
        pieces, count = ndimage.label(solid)
        if count == 0:
            raise ParticleError(f"it has no matter above {above:.2f} m in the object's frame")
        largest = 1 + int(np.bincount(pieces[pieces > 0])[1:].argmax())
        index = np.argwhere(pieces == largest)
        volumes = np.full(len(index), self.spacing**3)
        positions = self.origin + (index + 0.5) * self.spacing
        source = np.full(len(index), -1)
        return Particles(positions, volumes, volumes, source).with_mass(self.particles.mass)


def fill_object(
    cloud: GaussianCloud,
    size: Sequence[float],
    *,
    spacing: float,
    mass: float | None = None,
    category: str = "",
) -> Filling:
    """Convert an object to particles whose masses sum to its mass.

    The Gaussians in a voxel share its volume; a voxel without Gaussians gets one particle at its
    centre.

    Args:
        cloud: Gaussians, object frame with its origin at the box centre.
        size: (length, width, height) of the box [m].
        spacing: edge of a voxel [m]; about half a grid cell gives 8 particles per cell.
        mass: mass of the object [kg]; default of its category if not given.
        category: category of the object, for the default mass.

    Raises:
        ParticleError: for an object without solid Gaussians, a spacing that is not positive or too
            fine for this machine, or a mass that is not positive.
    """
    edges = np.asarray(size, dtype=np.float64)
    if not (np.isfinite(spacing) and spacing > 0):
        raise ParticleError(f"spacing must be positive [m], not {spacing!r}")
    counts = np.maximum(np.ceil(edges * (1 + 2 * BOX_SLACK) / spacing).astype(int), 1)
    check_memory(int(counts.prod()), "single")
    origin = -counts * spacing / 2
    index = _solid_gaussians(cloud, edges)
    shell = np.zeros(counts, dtype=bool)
    covered = np.floor((_covered_points(cloud, index, spacing) - origin) / spacing).astype(int)
    covered = covered[((covered >= 0) & (covered < counts)).all(axis=1)]
    shell[tuple(covered.T)] = True
    inside, sealed = _inside(shell, edges, origin, spacing)
    particles = _particles(cloud, index, shell | inside, origin, spacing)
    wanted = default_mass(category, size) if mass is None else mass
    return Filling(particles.with_mass(wanted), shell, inside, origin, spacing, sealed)


def _solid_gaussians(cloud: GaussianCloud, size: Float) -> NDArray[np.int64]:
    """Indices of the Gaussians that belong to the solid object."""
    means = cloud.means.detach().cpu().numpy().astype(np.float64)
    solid = cloud.opacities.detach().cpu().numpy() >= OPACITY_MIN
    slack = np.minimum(size * BOX_SLACK, BOX_SLACK_MAX)
    near = (np.abs(means) <= size / 2 + slack).all(axis=1)
    index = np.flatnonzero(solid & near & np.isfinite(means).all(axis=1))
    if len(index) == 0:
        raise ParticleError(
            f"none of {len(cloud)} Gaussians is in the box {tuple(size)} with opacity of at least "
            f"{OPACITY_MIN}; there is nothing to simulate"
        )
    return index


def _covered_points(cloud: GaussianCloud, index: NDArray[np.int64], spacing: float) -> Float:
    """Points [K, 3] that cover each Gaussian out to one standard deviation, a voxel apart."""
    means = cloud.means.detach().cpu().numpy()[index].astype(np.float64)
    scales = cloud.scales.detach().cpu().numpy()[index].astype(np.float64)
    axes = quaternion_to_matrix(cloud.quats.detach().cpu().numpy()[index])
    steps = np.clip(np.ceil(2 * scales / spacing), 1, SAMPLES_MAX).astype(int)
    points = []
    for shape in np.unique(steps, axis=0):
        own = (steps == shape).all(axis=1)
        ticks = [np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in shape]
        local = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        offsets = np.einsum("nij,nkj->nki", axes[own], local[None] * scales[own][:, None])
        points.append((means[own][:, None] + offsets).reshape(-1, 3))
    return np.concatenate(points)


@dataclass(frozen=True)
class _Side:
    """A side of the box, with the maximum depth of its surface below it."""

    axis: int
    sign: int
    depth: float

    @property
    def name(self) -> str:
        return f"{'-+'[self.sign > 0]}{'xyz'[self.axis]}"


# A bonnet is far below the roof line, and a windscreen far behind the bumper.
SIDES = (
    _Side(0, -1, 0.45), _Side(0, 1, 0.45),
    _Side(1, -1, 0.35), _Side(1, 1, 0.35),
    _Side(2, -1, 0.35), _Side(2, 1, 0.7),
)  # fmt: skip


def _inside(
    shell: Mask, size: Float, origin: Float, spacing: float
) -> tuple[Mask, tuple[str, ...]]:
    """Voxels not reachable from outside along an axis, and the sides closed by the box.

    Everything in front of the first surface is carved away from each side. Holes in a visible side
    are filled from their surroundings. A hardly visible side uses the depths of the opposite side
    if that is visible (street objects are roughly symmetric), else the face of the box.
    """
    solid = np.ones(shell.shape, dtype=bool)
    sealed = []
    for side in SIDES:
        depth, seen = _depth(shell, side)
        if not seen:
            sealed.append(side.name)
            face = (size[side.axis] / 2 + origin[side.axis]) / spacing
            opposite = _Side(side.axis, -side.sign, side.depth)
            other, other_seen = _depth(shell, opposite) if side.axis == 1 else (depth, False)
            rim = np.full_like(depth, max(round(-face), 0))
            depth = np.where(depth < len_along(shell, side), other if other_seen else rim, depth)
        along = _facing(solid, side)
        along &= np.arange(len(along))[:, None, None] >= depth
    return solid & ~shell, tuple(sealed)


def _facing(mask: Mask, side: _Side) -> Mask:
    """A view with the side's layer first."""
    along = np.moveaxis(mask, side.axis, 0)
    return along if side.sign < 0 else along[::-1]


def len_along(mask: Mask, side: _Side) -> int:
    """Number of voxels from that side of the box to the opposite one."""
    return int(mask.shape[side.axis])


def _depth(shell: Mask, side: _Side) -> tuple[NDArray[np.int64], bool]:
    """Layers [A, B] before the first surface (all outside the silhouette); whether it is seen."""
    along = _facing(shell, side)
    hit = along.any(axis=0)
    silhouette = ndimage.binary_closing(np.pad(hit, 4), iterations=4)[4:-4, 4:-4]
    silhouette = ndimage.binary_fill_holes(silhouette)
    first = np.where(hit, along.argmax(axis=0), len(along))
    own = hit & (first <= side.depth * len(along))
    seen = bool(own.sum() >= SEEN_FRACTION * silhouette.sum())
    if own.any():
        nearest = ndimage.distance_transform_edt(~own, return_distances=False, return_indices=True)
        first = first[tuple(nearest)]
        first = ndimage.median_filter(first, size=3, mode="nearest")
    return np.where(silhouette, first, len(along)), seen


def _particles(
    cloud: GaussianCloud, index: NDArray[np.int64], solid: Mask, origin: Float, spacing: float
) -> Particles:
    """Gaussians in solid voxels, and one particle for each solid voxel without Gaussians."""
    means = cloud.means.detach().cpu().numpy()[index].astype(np.float64)
    voxel = np.floor((means - origin) / spacing).astype(int)
    voxel = np.clip(voxel, 0, np.array(solid.shape) - 1)
    held = np.zeros(solid.shape, dtype=np.int64)
    np.add.at(held, tuple(voxel.T), 1)
    empty = np.argwhere(solid & (held == 0))
    volumes = np.concatenate([spacing**3 / held[tuple(voxel.T)], np.full(len(empty), spacing**3)])
    return Particles(
        positions=np.concatenate([means, origin + (empty + 0.5) * spacing]),
        volumes=volumes,
        masses=volumes,
        source=np.concatenate([index, np.full(len(empty), -1)]),
    )
