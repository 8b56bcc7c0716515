"""An object's Gaussians as particles, with the inside filled.

Voxels that Gaussians cover are the shell. Everything that can be reached from outside without
crossing the shell is outside, the rest is inside. Where cameras saw next to nothing of a side,
typically the underside, the tracked box closes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..scene import GaussianCloud
from ..scene.rotation import Float, quaternion_to_matrix
from .errors import ParticleError
from .masses import default_mass
from .model import check_memory
from .particles import Particles

OPACITY_MIN = 0.05
"""Fainter Gaussians are haze and carry no matter."""
BOX_SLACK = 0.1
"""Gaussians further outside the box than this share of its size are not matter of the object."""
SEEN_SHARE = 0.5
"""A side is seen when this share of the silhouette has matter within SEEN_DEPTH of the side."""
SEEN_DEPTH = 0.35
SAMPLES_MAX = 7
"""A Gaussian's extent is sampled by at most this many points along each of its axes."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Filling:
    """How a body was filled, to be looked at before it is simulated.

    Attributes:
        particles: Gaussians and interior, in the object's frame.
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


def fill_object(
    cloud: GaussianCloud,
    size: Sequence[float],
    *,
    spacing: float,
    mass: float | None = None,
    category: str = "",
) -> Filling:
    """Turn an object into particles whose masses sum to its mass.

    A voxel's volume is shared by the Gaussians in it; a voxel without any gets one particle at
    its centre.

    Args:
        cloud: Gaussians in the object's frame, origin at the box centre.
        size: (length, width, height) of the box [m].
        spacing: edge of a voxel [m]; about half a grid cell gives 8 particles per cell.
        mass: of the object [kg]; the category's default when not given.
        category: class of the object, for the default mass.

    Raises:
        ParticleError: for an object without matter, a spacing that is not positive or too fine
            for this machine, or a mass that is not positive.
    """
    edges = np.asarray(size, dtype=np.float64)
    if not (np.isfinite(spacing) and spacing > 0):
        raise ParticleError(f"spacing must be positive [m], not {spacing!r}")
    counts = np.maximum(np.ceil(edges * (1 + 2 * BOX_SLACK) / spacing).astype(int), 1)
    check_memory(int(counts.prod()), "single")
    origin = -counts * spacing / 2
    matter = _matter(cloud, edges)
    shell = np.zeros(counts, dtype=bool)
    covered = np.floor((_covered_points(cloud, matter, spacing) - origin) / spacing).astype(int)
    covered = covered[((covered >= 0) & (covered < counts)).all(axis=1)]
    shell[tuple(covered.T)] = True
    inside, sealed = _inside(shell, edges, origin, spacing)
    particles = _particles(cloud, matter, shell | inside, origin, spacing)
    wanted = default_mass(category, size) if mass is None else mass
    return Filling(particles.with_mass(wanted), shell, inside, origin, spacing, sealed)


def _matter(cloud: GaussianCloud, size: Float) -> NDArray[np.int64]:
    """Indices of the Gaussians that are matter of the object."""
    means = cloud.means.detach().cpu().numpy().astype(np.float64)
    solid = cloud.opacities.detach().cpu().numpy() >= OPACITY_MIN
    near = (np.abs(means) <= size * (0.5 + BOX_SLACK)).all(axis=1)
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


def _inside(
    shell: Mask, size: Float, origin: Float, spacing: float
) -> tuple[Mask, tuple[str, ...]]:
    """Voxels that cannot be reached from outside, and the sides that the box closed."""
    # Gaussians lie apart: gaps of up to two voxels count as closed.
    closed = np.pad(shell, 3)
    closed = ndimage.binary_closing(closed, ndimage.generate_binary_structure(3, 2), iterations=2)
    closed |= np.pad(shell, 3)
    sealed = []
    for axis in range(3):
        for sign in (-1, 1):
            if not _seen(shell, axis, sign):
                face = (sign * size[axis] / 2 - origin[axis]) / spacing
                layer = int(np.clip(np.floor(face - 0.5 * (sign > 0)), 0, shell.shape[axis] - 1))
                _seal(closed, shell, axis, layer + 3)
                sealed.append(f"{'-+'[sign > 0]}{'xyz'[axis]}")
    outside, _ = ndimage.label(~closed)
    inside = (outside != outside[0, 0, 0])[3:-3, 3:-3, 3:-3]
    return inside & ~shell, tuple(sealed)


def _seen(shell: Mask, axis: int, sign: int) -> bool:
    """Whether the side of the object facing ``sign`` along ``axis`` has enough matter near it."""
    along = np.moveaxis(shell, axis, 0)
    along = along if sign < 0 else along[::-1]
    silhouette = along.any(axis=0)
    depth = max(int(SEEN_DEPTH * len(along)), 1)
    return bool(along[:depth].any(axis=0).sum() >= SEEN_SHARE * silhouette.sum())


def _seal(closed: Mask, shell: Mask, axis: int, layer: int) -> None:
    """Close a layer of voxels across the object's silhouette, holes in it included."""
    silhouette = ndimage.binary_closing(np.pad(shell.any(axis=axis), 3), iterations=3)
    silhouette = ndimage.binary_fill_holes(silhouette)
    # Walls reach down to the lid, so that nothing creeps in between.
    lid = [slice(None)] * 3
    lid[axis] = layer
    closed[tuple(lid)] |= silhouette
    rim = silhouette & ~ndimage.binary_erosion(silhouette, iterations=2)
    line = np.moveaxis(closed, axis, 0)
    first, last = _extent(shell, axis)
    low, high = sorted((layer, (first if layer <= first + 3 else last) + 3))
    line[low : high + 1] |= rim


def _extent(shell: Mask, axis: int) -> tuple[int, int]:
    """First and last layer with matter."""
    layers = np.flatnonzero(np.moveaxis(shell, axis, 0).any(axis=(1, 2)))
    return int(layers[0]), int(layers[-1])


def _particles(
    cloud: GaussianCloud, matter: NDArray[np.int64], solid: Mask, origin: Float, spacing: float
) -> Particles:
    """Gaussians in solid voxels, and one particle for each solid voxel without any."""
    means = cloud.means.detach().cpu().numpy()[matter].astype(np.float64)
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
        source=np.concatenate([matter, np.full(len(empty), -1)]),
    )
