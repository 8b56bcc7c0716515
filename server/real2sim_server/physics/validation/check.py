"""Checks of the validation table, and setups shared by cases."""

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
    """A measured curve over time or space with its theory, for the HTML page.

    Attributes:
        x, measured, expected: arrays of equal length; ``expected`` may be NaN.
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
        name: name of the quantity, with its case.
        measured, expected: values in ``unit``.
        tolerance: maximum allowed difference, in ``unit``.
        unit: SI unit, empty for ratios.
        curve: underlying curve, or None.
    """

    name: str
    measured: float
    expected: float
    tolerance: float
    unit: str = ""
    curve: ReferenceCurve | None = None

    @property
    def passed(self) -> bool:
        """Whether the values agree; False for NaN."""
        return bool(abs(self.measured - self.expected) <= self.tolerance)


def placed(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Transform [4, 4] of a translation."""
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
    """A solver; by default in double precision without gravity."""
    defaults = {"dx": 0.1, "gravity": (0.0, 0.0, 0.0), "precision": "double"}
    return Solver(bodies, colliders, SolverOptions(**{**defaults, **options}))  # type: ignore[arg-type]
