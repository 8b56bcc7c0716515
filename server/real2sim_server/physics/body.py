"""Bodies: particles with a material, a motion and a surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.rotation import Float
from .errors import MaterialError, ParticleError
from .materials import Material
from .particles import Particles


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """One thing that moves and deforms, in the world frame.

    Attributes:
        name: unique among the bodies of a solver.
        particles: placed in the world.
        material: one material, or several that ``regions`` chooses from.
        regions: [N] int, which material a particle is of; all of the first when not given.
        velocity: [3] of the centre of mass [m/s].
        angular_velocity: [3] about the centre of mass [rad/s].
        friction: Coulomb coefficient of its surface, >= 0; between two bodies the geometric mean
            of both holds, at a collider the collider's where it has one.
        particle_velocities: [N, 3] [m/s], instead of a rigid motion.
        particle_gradients: [N, 3, 3] velocity gradients [1/s]; those of the rigid motion when not
            given.
        history: [N] plastic memory, as ``BodyState.history`` gave it; none when not given.
        deformation: [N, 3, 3] initial F_elastic; identity when not given.
        total_deformation: [N, 3, 3] initial F_total, of an already dented body; ``deformation``
            when not given.

    Raises:
        ParticleError, MaterialError: for shapes and values that do not fit.
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
        """[N, 3] of its particles at the start [m/s]."""
        if self.particle_velocities is not None:
            return self.particle_velocities
        r = self.particles.positions - self.particles.centre_of_mass
        return np.asarray(self.velocity) + np.cross(np.asarray(self.angular_velocity), r)

    @property
    def gradients(self) -> Float:
        """[N, 3, 3] velocity gradients of its particles at the start [1/s]."""
        if self.particle_gradients is not None:
            return self.particle_gradients
        x, y, z = np.asarray(self.angular_velocity)
        spin = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.tile(spin, (len(self.particles), 1, 1))


def _determinants(matrices: Float) -> Float:
    """[N] of [N, 3, 3], without factorising each."""
    x, y, z = (matrices[:, row].T for row in range(3))
    found: Float = (
        x[0] * (y[1] * z[2] - y[2] * z[1])
        + x[1] * (y[2] * z[0] - y[0] * z[2])
        + x[2] * (y[0] * z[1] - y[1] * z[0])
    )
    return found
