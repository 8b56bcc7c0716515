"""Checks of the validation table, and the small setups that cases share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..body import Body, box_particles
from ..colliders import Collider
from ..materials import Material
from ..solver import Solver, SolverOptions


@dataclass(frozen=True)
class ReferenceCurve:
    """A measured quantity over time or space beside its theory, for the page.

    Attributes:
        x, measured, expected: of one length; ``expected`` may hold NaN where theory is silent.
        x_label, y_label: with units.
    """

    x: Sequence[float]
    measured: Sequence[float]
    expected: Sequence[float]
    x_label: str
    y_label: str


@dataclass(frozen=True)
class Check:
    """A measured value against theory.

    Attributes:
        name: what it is, with its case.
        measured, expected: the two numbers, in ``unit``.
        tolerance: largest allowed distance of the two, in ``unit``.
        unit: SI unit, empty for ratios.
        curve: what led to it, where that says more than a number.
    """

    name: str
    measured: float
    expected: float
    tolerance: float
    unit: str = ""
    curve: ReferenceCurve | None = None

    @property
    def passed(self) -> bool:
        """Whether they agree; never for a NaN."""
        return bool(abs(self.measured - self.expected) <= self.tolerance)


def placed(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Transform [4, 4] that only shifts."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def block(
    material: Material,
    *,
    size: Sequence[float] = (0.4, 0.4, 0.4),
    spacing: float = 0.05,
    at: Sequence[float] = (0.0, 0.0, 0.0),
    name: str = "block",
    **options: object,
) -> Body:
    """A box of lattice particles centred on ``at`` [m], with the material's density."""
    particles = box_particles(size, spacing=spacing, density=material.density)
    return Body(name=name, particles=particles.moved(placed(*at)), material=material, **options)  # type: ignore[arg-type]


def solve(bodies: Sequence[Body], colliders: Sequence[Collider] = (), **options: object) -> Solver:
    """A solver in double precision without gravity, where ``options`` say nothing else."""
    defaults = {"dx": 0.1, "gravity": (0.0, 0.0, 0.0), "precision": "double"}
    return Solver(bodies, colliders, SolverOptions(**{**defaults, **options}))  # type: ignore[arg-type]
