"""What every solver backend takes and gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ..colliders import Box, Collider, HeightField, Plane
from ..constitutive import obstacle
from ..constitutive.contact import STICKS

TOTALS = 8
"""Columns of contact totals, all on a body: impulse (3) [N s], its moment about the world origin
(3) [N m s], friction heat [J], work of the other's motion [J].

Heat is impulse times slip after the touch, work is impulse times the velocity of the other: both
are what the impulse did over the substep, whatever the stresses did at the same node.
"""


@dataclass(frozen=True, eq=False)
class ParticleArrays:
    """State of all particles of all bodies, body after body, float64.

    Attributes:
        positions: [N, 3] [m].
        velocities: [N, 3] [m/s].
        gradients: [N, 3, 3] APIC velocity gradient [1/s].
        F_elastic: [N, 3, 3], drives stress.
        F_total: [N, 3, 3], drives what is seen.
        history: [N] plastic memory, see ``laws.stress``.
    """

    positions: Float
    velocities: Float
    gradients: Float
    F_elastic: Float
    F_total: Float
    history: Float


@dataclass(frozen=True, eq=False)
class Model:
    """A checked simulation, ready for a backend.

    Attributes:
        start: particles at the start.
        masses, volumes: [N] float64 [kg], [m^3].
        material: [N] int64, row of ``table``.
        body: [N] int64, increasing.
        table: [K, ROW] float64, ``Material.row``.
        friction: [B] float64, of the bodies' surfaces.
        dx: cell size of the grid [m].
        gravity: [3] [m/s^2].
        dtype: float32 or float64, precision of the state where the backend has a choice.
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
        """Whether no particle has left the numbers."""
        sums = (self.centre.sum(), self.kinetic.sum(), self.elastic.sum())
        bounds = (self.max_speed, self.max_wave_speed, self.min_volume_ratio)
        return bool(np.isfinite([*sums, *bounds]).all())


class Simulation(Protocol):
    """A model in motion on one backend."""

    def advance(self, steps: int, dt: float, colliders: Sequence[Collider]) -> None:
        """Make ``steps`` substeps of ``dt`` [s]; moving colliders start where they are given."""
        ...

    def measure(self) -> Measure:
        """Sums and bounds of the present state."""
        ...

    def particles(self) -> ParticleArrays:
        """A copy of the present state, in the order of the model."""
        ...

    def contacts(self) -> tuple[Float, Float]:
        """Totals since the start: on bodies by colliders [B, K, TOTALS], by bodies [B, B, TOTALS].

        Between bodies each side counts half of the heat.
        """
        ...

    def save(self) -> Any:
        """The present state, bit by bit."""
        ...

    def restore(self, saved: Any) -> None:
        """Go back to a saved state."""
        ...


class Backend(Protocol):
    """One way to compute; all members agree within the precision they work in."""

    name: str

    def start(self, model: Model, colliders: Sequence[Collider]) -> Simulation:
        """Load a model. The number and kind of colliders stay the same."""
        ...


def pack_colliders(colliders: Sequence[Collider]) -> tuple[Float, Float]:
    """Rows [K, COLLIDER_ROW] and the heights [H] of all height fields, as the laws read them."""
    rows = np.zeros((len(colliders), obstacle.COLLIDER_ROW))
    heights: list[Float] = []
    stored = 0
    for row, collider in zip(rows, colliders, strict=True):
        own = collider.friction
        row[obstacle.FRICTION] = -1.0 if own is None else min(own, float(STICKS))
        row[obstacle.SEPARABLE] = collider.separable
        if isinstance(collider, Plane):
            row[obstacle.KIND] = obstacle.PLANE
            row[obstacle.POINT : obstacle.POINT + 3] = collider.point
            row[obstacle.AXES : obstacle.AXES + 3] = collider.normal
        elif isinstance(collider, Box):
            _pack_box(row, collider)
        elif isinstance(collider, HeightField):
            row[obstacle.KIND] = obstacle.HEIGHT_FIELD
            row[obstacle.POINT : obstacle.POINT + 2] = collider.origin
            row[obstacle.FIRST_HEIGHT] = stored
            row[obstacle.COUNT_X], row[obstacle.COUNT_Y] = collider.heights.shape
            row[obstacle.SPACING] = collider.spacing
            heights.append(collider.heights.ravel())
            stored += collider.heights.size
    return rows, np.concatenate(heights) if heights else np.zeros(0)


def _pack_box(row: Float, box: Box) -> None:
    pose = np.asarray(box.T_world_box)
    row[obstacle.KIND] = obstacle.BOX
    row[obstacle.POINT : obstacle.POINT + 3] = pose[:3, 3]
    row[obstacle.AXES : obstacle.AXES + 9] = pose[:3, :3].ravel()
    row[obstacle.HALF_SIZE : obstacle.HALF_SIZE + 3] = np.asarray(box.size) / 2
    row[obstacle.SPIN : obstacle.SPIN + 3] = box.angular_velocity
    row[obstacle.SPEED : obstacle.SPEED + 3] = box.velocity


class SolverDiverged(Exception):
    """Particles left the numbers or the grid within a step; the state is lost, go back."""
