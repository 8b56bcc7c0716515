"""Construction of a validated model from bodies, and the Protocol of solver backends."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float
from . import contact as collider_rows
from . import stress
from .body import Body
from .colliders import Box, Capsule, Collider, Cylinder, HeightField, Plane, Solid, TriangleMesh
from .contact import STICKS, THIN_CELLS
from .errors import ParticleError, SolverError
from .materials import Material, law_of_code

# The interface of solver backends.

TOTALS = 8
"""Columns of contact totals, all on a body: impulse (3) [N s], its moment about the world origin
(3) [N m s], friction work [J], work of the other's motion [J].

Friction work is impulse times slip after the contact, and the other's work is impulse times its
velocity. Both are the work of the impulse over the substep, whatever the stresses do at the same
node.
"""


@dataclass(frozen=True, eq=False)
class ParticleArrays:
    """State of all particles of all bodies, body after body, float64.

    Attributes:
        positions: [N, 3] [m].
        velocities: [N, 3] [m/s].
        gradients: [N, 3, 3] APIC velocity gradient [1/s].
        F_elastic: [N, 3, 3], determines stress.
        F_total: [N, 3, 3], determines the visible deformation.
        history: [N] plastic memory, see ``stress.stress_update``.
    """

    positions: Float
    velocities: Float
    gradients: Float
    F_elastic: Float
    F_total: Float
    history: Float


@dataclass(frozen=True, eq=False)
class Model:
    """A validated simulation model for a backend.

    Attributes:
        start: particles at the start.
        masses, volumes: [N] float64 [kg], [m^3].
        material: [N] int64, row of ``table``.
        body: [N] int64, increasing.
        table: [K, MATERIAL_ROW] float64, ``Material.row``.
        friction: [B] float64, friction coefficients of the bodies' surfaces.
        dx: cell size of the grid [m].
        gravity: [3] [m/s^2].
        dtype: float32 or float64, precision of the state if the backend supports both.

    Raises:
        MaterialError: for an unknown law in ``table``.
    """

    start: ParticleArrays
    masses: Float
    volumes: Float
    material: NDArray[np.int64]
    body: NDArray[np.int64]
    table: Float
    friction: Float
    dx: float
    gravity: Float
    dtype: type[np.floating[Any]]

    def __post_init__(self) -> None:
        for code in np.unique(self.table[:, stress.LAW]).tolist():
            law_of_code(code)

    @property
    def plastic(self) -> NDArray[np.bool_]:
        """[N] whether particles have separate F_total and history."""
        flags: NDArray[np.bool_] = self.table[self.material, stress.PLASTIC] > 0
        return flags

    @property
    def bodies(self) -> int:
        """Number of bodies B."""
        return len(self.friction)


@dataclass(frozen=True, eq=False)
class Measure:
    """Sums over each body, float64, and bounds over all particles.

    Attributes:
        mass: [B] [kg].
        centre: [B, 3] centre of mass [m].
        momentum: [B, 3] [kg m/s].
        angular_momentum: [B, 3] about the world origin, APIC's affine part included [kg m^2/s].
        kinetic: [B] kinetic energy, affine part included [J].
        elastic: [B] stored energy [J].
        max_speed: fastest particle [m/s].
        max_wave_speed: fastest pressure wave in the deformed material [m/s].
        min_volume_ratio: smallest det F_elastic.
    """

    mass: Float
    centre: Float
    momentum: Float
    angular_momentum: Float
    kinetic: Float
    elastic: Float
    max_speed: float
    max_wave_speed: float
    min_volume_ratio: float

    @property
    def finite(self) -> bool:
        """Whether all values are finite."""
        sums = (self.centre.sum(), self.kinetic.sum(), self.elastic.sum())
        bounds = (self.max_speed, self.max_wave_speed, self.min_volume_ratio)
        return bool(np.isfinite([*sums, *bounds]).all())


class Simulation(Protocol):
    """A running simulation on one backend."""

    def advance(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        """Make ``steps`` substeps of ``dt`` [s]; moving colliders start at their given poses."""
        ...

    def measure(self) -> Measure:
        """Sums and bounds of the current state."""
        ...

    def particles(self) -> ParticleArrays:
        """A copy of the current state, in the order of the model."""
        ...

    def contacts(self) -> tuple[Float, Float]:
        """Totals since the start: on bodies by colliders [B, K, TOTALS], by bodies [B, B, TOTALS].

        Between bodies, each side counts half of the friction work.
        """
        ...

    def save(self) -> Any:
        """The complete current state."""
        ...

    def restore(self, saved: Any) -> None:
        """Restore a saved state."""
        ...


class SolverBackend(Protocol):
    """A solver implementation; all backends agree within their precision."""

    name: str

    def start(self, model: Model, colliders: Sequence[Collider]) -> Simulation:
        """Load a model. The number and types of colliders must not change later."""
        ...


def is_thin(collider: Collider, dx: float) -> bool:
    """Whether a collider contains too few nodes of a grid of ``dx`` [m] to stop a body."""
    return isinstance(collider, Solid) and collider.thickness < THIN_CELLS * dx


def pack_colliders(colliders: Sequence[Collider], dx: float) -> tuple[Float, Float]:
    """Colliders in kernel form: rows [K, COLLIDER_ROW], data [H] of height fields and meshes."""
    rows = np.zeros((len(colliders), collider_rows.COLLIDER_ROW))
    heights: list[Float] = []
    stored = 0
    for row, collider in zip(rows, colliders, strict=True):
        own = collider.friction
        row[collider_rows.FRICTION] = -1.0 if own is None else min(own, float(STICKS))
        row[collider_rows.SEPARABLE] = collider.separable
        row[collider_rows.THIN] = is_thin(collider, dx)
        if isinstance(collider, Plane):
            row[collider_rows.KIND] = collider_rows.PLANE
            row[collider_rows.POINT : collider_rows.POINT + 3] = collider.point
            row[collider_rows.AXES : collider_rows.AXES + 3] = collider.normal
        elif isinstance(collider, Solid):
            _pack_solid(row, collider)
            if isinstance(collider, TriangleMesh):
                row[collider_rows.FIRST_NODE] = stored
                heights.append(collider.surface.packed)
        elif isinstance(collider, HeightField):
            row[collider_rows.KIND] = collider_rows.HEIGHT_FIELD
            row[collider_rows.POINT : collider_rows.POINT + 2] = collider.origin
            row[collider_rows.FIRST_HEIGHT] = stored
            row[collider_rows.COUNT_X], row[collider_rows.COUNT_Y] = collider.heights.shape
            row[collider_rows.SPACING] = collider.spacing
            heights.append(collider.heights.ravel())
        stored = sum(len(h) for h in heights)
    return rows, np.concatenate(heights) if heights else np.zeros(0)


def _pack_solid(row: Float, solid: Solid) -> None:
    pose, size = solid.pose, slice(collider_rows.HALF_SIZE, collider_rows.HALF_SIZE + 3)
    row[collider_rows.POINT : collider_rows.POINT + 3] = pose[:3, 3]
    row[collider_rows.AXES : collider_rows.AXES + 9] = pose[:3, :3].ravel()
    row[collider_rows.SPIN : collider_rows.SPIN + 3] = solid.angular_velocity
    row[collider_rows.SPEED : collider_rows.SPEED + 3] = solid.velocity
    if isinstance(solid, Box):
        row[collider_rows.KIND] = collider_rows.BOX
        row[size] = np.asarray(solid.size) / 2
    elif isinstance(solid, Cylinder):
        row[collider_rows.KIND] = collider_rows.CYLINDER
        row[size] = solid.radius, solid.height / 2, 0.0
    elif isinstance(solid, Capsule):
        row[collider_rows.KIND] = collider_rows.CAPSULE
        row[size] = solid.radius, solid.length / 2, 0.0
    elif isinstance(solid, TriangleMesh):
        row[collider_rows.KIND] = collider_rows.MESH
        row[collider_rows.NODES] = solid.surface.nodes
        row[collider_rows.HALF_THICKNESS] = (solid.surface.thickness or 0.0) / 2


class SolverDiverged(Exception):
    """Particles became non-finite or left the grid within a step; restore an earlier state."""


PRECISIONS: dict[str, type[np.floating[Any]]] = {"single": np.float32, "double": np.float64}
BODIES_MAX = 4096
"""Limit of the grid's block keys."""
BYTES_PER_PARTICLE = {"single": 900, "double": 1400}
"""Measured peak memory while solving, including saved state and float64 copies [bytes]."""


def build_model(
    bodies: Sequence[Body], *, dx: float | None, gravity: ArrayLike, precision: str
) -> Model:
    """Build one model of all bodies.

    Raises:
        SolverError: for invalid options.
        ParticleError: for more particles than fit in memory, or too sparse ones.
    """
    if not 0 < len(bodies) <= BODIES_MAX:
        raise SolverError(f"a solver takes 1 to {BODIES_MAX} bodies, not {len(bodies)}")
    names = [b.name for b in bodies]
    if len(set(names)) < len(names):
        raise SolverError(f"names of bodies must be unique, not {names}")
    if precision not in PRECISIONS:
        raise SolverError(f"unknown precision {precision!r}; allowed are {sorted(PRECISIONS)}")
    g = np.array(gravity, dtype=np.float64)
    if g.shape != (3,) or not np.isfinite(g).all():
        raise SolverError(f"gravity must be 3 finite numbers [m/s^2], not {gravity!r}")
    check_memory(sum(len(b.particles) for b in bodies), precision)
    spacing = max(float(np.median(np.cbrt(b.particles.volumes))) for b in bodies)
    cell = 2 * spacing if dx is None else float(dx)
    if not (np.isfinite(cell) and cell > 0):
        raise SolverError(f"dx must be a positive length [m], not {dx!r}")
    if spacing > cell:
        raise ParticleError(
            f"particles {spacing:.3g} m apart do not see each other on cells of {cell:.3g} m; "
            f"take dx of {2 * spacing:.3g} m, or fill with more particles"
        )
    return _assemble(bodies, cell, g, PRECISIONS[precision])


def check_memory(particles: int, precision: str) -> None:
    """Check that a model fits in memory, before any allocation.

    Raises:
        ParticleError: if not, with the required and the available memory.
    """
    needed, free = particles * BYTES_PER_PARTICLE[precision], available_memory()
    if needed > 0.8 * free:
        raise ParticleError(
            f"{particles:,} particles need about {needed / 2**30:.1f} GiB and "
            f"{free / 2**30:.1f} GiB are free; take larger cells or fewer bodies"
        )


def available_memory() -> int:
    """Available memory of this machine [bytes]."""
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _assemble(
    bodies: Sequence[Body], dx: float, gravity: Any, dtype: type[np.floating[Any]]
) -> Model:
    sizes = [len(b.particles) for b in bodies]
    body = np.repeat(np.arange(len(bodies)), sizes)
    materials: list[Material] = []
    index = []
    for b in bodies:
        index.append(np.asarray(b.regions) + len(materials))
        materials.extend(b.materials)
    elastic = np.concatenate([_deformation(b, "deformation") for b in bodies])
    total = np.concatenate([_deformation(b, "total_deformation") for b in bodies])
    positions = np.concatenate([b.particles.positions for b in bodies])
    return Model(
        start=ParticleArrays(
            positions,
            np.concatenate([b.velocities for b in bodies]),
            np.concatenate([b.gradients for b in bodies]),
            elastic,
            total,
            np.concatenate(
                [np.zeros(len(b.particles)) if b.history is None else b.history for b in bodies]
            ),
        ),
        masses=np.concatenate([b.particles.masses for b in bodies]),
        volumes=np.concatenate([b.particles.volumes for b in bodies]),
        material=np.concatenate(index),
        body=body,
        table=np.stack([m.row() for m in materials]),
        friction=np.array([min(b.friction, float(STICKS)) for b in bodies], np.float64),
        dx=dx,
        gravity=gravity,
        dtype=dtype,
    )


def _deformation(body: Body, name: str) -> Any:
    value = getattr(body, name)
    if value is None:
        value = body.deformation
    if value is None:
        return np.tile(np.eye(3), (len(body.particles), 1, 1))
    return value
