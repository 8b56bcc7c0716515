"""Bodies: particles with mass and volume, a material, a motion and a surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float, apply_transform, is_rigid
from .errors import MaterialError, ParticleError
from .materials import Material

BISECTIONS = 40


@dataclass(frozen=True, eq=False)
class Particles:
    """Particles at rest in one frame.

    Attributes:
        positions: [N, 3] float64 [m].
        volumes: [N] float64 rest volumes [m^3], > 0.
        masses: [N] float64 [kg], > 0.
        source: [N] int64, index of the Gaussian of each particle, -1 for interior fill.

    Raises:
        ParticleError: no particles, mismatched shapes, values that are not finite or not positive.
    """

    positions: Float
    volumes: Float
    masses: Float
    source: NDArray[np.int64]

    def __post_init__(self) -> None:
        for name in ("positions", "volumes", "masses"):
            value = np.array(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "source", np.array(self.source, dtype=np.int64))
        n = len(self.positions)
        if n == 0:
            raise ParticleError("a body needs at least one particle; it has none")
        shapes = {"positions": (n, 3), "volumes": (n,), "masses": (n,), "source": (n,)}
        for name, shape in shapes.items():
            given = getattr(self, name).shape
            if given != shape:
                raise ParticleError(f"{name} of {n} particles must be {shape}, not {given}")
        _require(np.asarray(np.isfinite(self.positions).all(axis=1)), "positions are not finite")
        _require(np.isfinite(self.volumes) & (self.volumes > 0), "volumes are not positive")
        _require(np.isfinite(self.masses) & (self.masses > 0), "masses are not positive")

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def mass(self) -> float:
        """Mass of all particles [kg]."""
        return float(self.masses.sum())

    @property
    def centre_of_mass(self) -> Float:
        """[3] [m]."""
        centre: Float = self.masses @ self.positions / self.masses.sum()
        return centre

    @property
    def inertia(self) -> Float:
        """[3, 3] inertia about the centre of mass [kg m^2]; each particle is a small cube.

        With the cubes' own inertia m V^(2/3) / 6, a lattice of particles is exact for a box.
        """
        r = self.positions - self.centre_of_mass
        second = np.einsum("n,ni,nj->ij", self.masses, r, r)
        own = float((self.masses * np.cbrt(self.volumes) ** 2).sum()) / 6
        inertia: Float = np.trace(second) * np.eye(3) - second + own * np.eye(3)
        return inertia

    def moved(self, T_dst_src: ArrayLike) -> Particles:
        """The particles in another frame, by a rigid [4, 4] transform."""
        matrix = np.asarray(T_dst_src, dtype=np.float64)
        if not is_rigid(matrix):
            raise ParticleError(f"T_dst_src must be a rigid [4, 4] transform, not {matrix!r}")
        return replace(self, positions=apply_transform(matrix, self.positions))

    def take(self, index: NDArray[Any]) -> Particles:
        """A subset of the particles; ``index``: indices in any order, or a mask [N]."""
        return Particles(
            self.positions[index], self.volumes[index], self.masses[index], self.source[index]
        )

    def with_mass(self, mass: float) -> Particles:
        """The particles with masses scaled so that they sum to ``mass`` [kg]."""
        if not (np.isfinite(mass) and mass > 0):
            raise ParticleError(f"mass of a body must be positive [kg], not {mass!r}")
        return replace(self, masses=self.masses * (mass / self.masses.sum()))

    def with_centre_height(self, height: float) -> Particles:
        """The particles with mass redistributed for a centre of mass at z = ``height`` [m].

        The mass of each layer is scaled by exp(-k z), so lower layers become denser. For heights
        out of range, every layer keeps at least a tenth of a percent.
        """
        z = self.positions[:, 2] - self.centre_of_mass[2]
        most = np.log(1e3) / max(float(np.ptp(z)), 1e-9)
        low, high = -most, most
        wanted = height - self.centre_of_mass[2]
        for _ in range(BISECTIONS):
            k = (low + high) / 2
            weights = self.masses * np.exp(-k * z)
            if float(weights @ z) / float(weights.sum()) > wanted:
                low = k
            else:
                high = k
        mass = self.masses.sum()
        return replace(self, masses=weights * (mass / weights.sum()))


def box_particles(size: ArrayLike, *, spacing: float, density: float) -> Particles:
    """A box centred on the origin, filled with a cubic lattice of particles.

    Args:
        size: [3] edge lengths [m].
        spacing: approximate particle spacing [m]; adjusted to fill the box.
        density: mass per volume [kg/m^3].

    Raises:
        ParticleError: if size, spacing or density is not positive.
    """
    edges = np.asarray(size, dtype=np.float64)
    if edges.shape != (3,) or not (edges > 0).all() or not spacing > 0 or not density > 0:
        raise ParticleError(
            f"a box needs three positive edges, spacing and density, not {size!r}, {spacing!r}, "
            f"{density!r}"
        )
    counts = np.maximum(np.rint(edges / spacing).astype(int), 1)
    axes = [(np.arange(n) + 0.5) / n * e - e / 2 for n, e in zip(counts, edges, strict=True)]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return _uniform(positions, float(edges.prod()) / len(positions), density)


def ball_particles(radius: float, *, spacing: float, density: float) -> Particles:
    """A ball centred on the origin, cut from a cubic lattice; volumes sum to the ball's.

    Raises:
        ParticleError: if radius, spacing or density is not positive.
    """
    if not (radius > 0 and spacing > 0 and density > 0):
        raise ParticleError(
            f"a ball needs positive radius, spacing, density: {radius!r}, {spacing!r}, {density!r}"
        )
    lattice = box_particles([2 * radius] * 3, spacing=spacing, density=density).positions
    inside = lattice[(lattice**2).sum(axis=1) < radius**2]
    return _uniform(inside, 4 / 3 * np.pi * radius**3 / max(len(inside), 1), density)


def _uniform(positions: Float, volume: float, density: float) -> Particles:
    n = len(positions)
    return Particles(
        positions, np.full(n, volume), np.full(n, volume * density), np.full(n, -1, np.int64)
    )


def _require(holds: NDArray[Any], problem: str) -> None:
    count = int((~holds).sum())
    if count:
        first = int(np.flatnonzero(~holds)[0])
        raise ParticleError(f"{count} of {len(holds)} particles: {problem} (first: {first})")


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """A deformable body in the world frame.

    Attributes:
        name: unique name in a solver.
        particles: particles, world frame.
        material: one material, or several that ``regions`` selects from.
        regions: [N] int, material index of each particle; the first material if not given.
        velocity: [3] velocity of the centre of mass [m/s].
        angular_velocity: [3] about the centre of mass [rad/s].
        friction: Coulomb coefficient of its surface, >= 0. Between two bodies, the geometric mean
            applies; at a collider, the collider's coefficient if it has one.
        particle_velocities: [N, 3] [m/s], instead of a rigid motion.
        particle_gradients: [N, 3, 3] velocity gradients [1/s]; those of the rigid motion if not
            given.
        history: [N] plastic memory, as in ``BodyState.history``; none if not given.
        deformation: [N, 3, 3] initial F_elastic; identity if not given.
        total_deformation: [N, 3, 3] initial F_total of an already dented body; ``deformation`` if
            not given.

    Raises:
        ParticleError, MaterialError: for invalid shapes and values.
    """

    name: str
    particles: Particles
    material: Material | Sequence[Material]
    regions: NDArray[np.int64] | None = None
    velocity: ArrayLike = (0.0, 0.0, 0.0)
    angular_velocity: ArrayLike = (0.0, 0.0, 0.0)
    friction: float = 0.5
    particle_velocities: Float | None = None
    particle_gradients: Float | None = None
    history: Float | None = None
    deformation: Float | None = None
    total_deformation: Float | None = None
    materials: tuple[Material, ...] = field(init=False)

    def __post_init__(self) -> None:
        given = self.material
        materials = (given,) if isinstance(given, Material) else tuple(given)
        if not materials or not all(isinstance(m, Material) for m in materials):
            raise MaterialError(f"body {self.name!r} needs a material or several, not {given!r}")
        object.__setattr__(self, "materials", materials)
        for name in ("velocity", "angular_velocity"):
            vector = np.array(getattr(self, name), dtype=np.float64)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise ParticleError(
                    f"{name} of body {self.name!r} must be 3 finite numbers: {vector!r}"
                )
            object.__setattr__(self, name, vector)
        if not (self.friction >= 0 and not math.isnan(self.friction)):
            raise MaterialError(
                f"friction of body {self.name!r} must not be negative: {self.friction!r}"
            )
        self._check_regions()
        for name, shape in (
            ("particle_velocities", (3,)),
            ("particle_gradients", (3, 3)),
            ("history", ()),
        ):
            self._check_array(name, shape)
        self._check_deformation("deformation")
        self._check_deformation("total_deformation")

    def _check_regions(self) -> None:
        n = len(self.particles)
        regions = np.zeros(n, np.int64) if self.regions is None else np.asarray(self.regions)
        count = len(self.materials)
        if regions.shape != (n,) or regions.min() < 0 or regions.max() >= count:
            raise MaterialError(
                f"regions of body {self.name!r} must be ({n},) indices below {count}, its number "
                f"of materials; they are {regions.shape}, {regions.min()} to {regions.max()}"
            )
        object.__setattr__(self, "regions", regions.astype(np.int64))

    def _check_array(self, name: str, shape: tuple[int, ...]) -> None:
        if getattr(self, name) is None:
            return
        value = np.array(getattr(self, name), dtype=np.float64)
        wanted = (len(self.particles), *shape)
        if value.shape != wanted or not np.isfinite(value).all():
            raise ParticleError(
                f"{name} of body {self.name!r} must be {wanted} and finite, not {value.shape}"
            )
        object.__setattr__(self, name, value)

    def _check_deformation(self, name: str) -> None:
        value = getattr(self, name)
        if value is None:
            return
        F = np.array(value, dtype=np.float64)
        n = len(self.particles)
        if F.shape != (n, 3, 3) or not np.isfinite(F).all() or (_determinants(F) <= 0).any():
            raise ParticleError(
                f"{name} of body {self.name!r} must be ({n}, 3, 3), finite, with det > 0"
            )
        object.__setattr__(self, name, F)

    @property
    def velocities(self) -> Float:
        """[N, 3] initial particle velocities [m/s]."""
        if self.particle_velocities is not None:
            return self.particle_velocities
        r = self.particles.positions - self.particles.centre_of_mass
        return np.asarray(self.velocity) + np.cross(np.asarray(self.angular_velocity), r)

    @property
    def gradients(self) -> Float:
        """[N, 3, 3] initial velocity gradients of its particles [1/s]."""
        if self.particle_gradients is not None:
            return self.particle_gradients
        x, y, z = np.asarray(self.angular_velocity)
        spin = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.tile(spin, (len(self.particles), 1, 1))


def _determinants(matrices: Float) -> Float:
    """[N] determinants of [N, 3, 3], without factorisation."""
    x, y, z = (matrices[:, row].T for row in range(3))
    found: Float = (
        x[0] * (y[1] * z[2] - y[2] * z[1])
        + x[1] * (y[2] * z[0] - y[0] * z[2])
        + x[2] * (y[0] * z[1] - y[1] * z[0])
    )
    return found
