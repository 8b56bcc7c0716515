"""Materials that keep dents: they flow, pack or come apart."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from ..constitutive.law import (
    CRUSH,
    DRUCKER_PRAGER,
    SNOW,
    VISCOPLASTIC,
    VON_MISES,
    ConstitutiveLaw,
)
from .material import Material, register_material


@register_material("metal", young=2e8, density=300.0, yield_stress=4e6, hardening=2e7)
@dataclass(frozen=True, kw_only=True)
class Metal(Material):
    """Hencky elasticity with von Mises yield and linear hardening: keeps dents.

    The named one is a car body's sheet metal smeared over its volume.

    Attributes:
        yield_stress: uniaxial yield stress [Pa], > 0.
        hardening: tangent modulus of plastic flow [Pa], >= 0.
    """

    constitutive_law: ClassVar[ConstitutiveLaw] = VON_MISES

    yield_stress: float
    hardening: float = 0.0

    def law_parameters(self) -> tuple[float, ...]:  # noqa: D102
        return self.yield_stress, self.hardening

    @property
    def strength(self) -> float:  # noqa: D102
        return self.yield_stress

    def _check(self) -> None:
        self._require("yield_stress", self.yield_stress > 0, "must be positive")
        self._require("hardening", self.hardening >= 0, "must not be negative")


@register_material("foam", young=4e5, density=60.0, yield_stress=3e4, viscosity=400.0)
@dataclass(frozen=True, kw_only=True)
class Foam(Material):
    """Hencky elasticity with viscoplastic flow (Yue et al. 2015).

    Attributes:
        yield_stress: below this it is elastic [Pa], > 0.
        plastic_viscosity: how slowly it flows above [Pa s], >= 0.
    """

    constitutive_law: ClassVar[ConstitutiveLaw] = VISCOPLASTIC

    yield_stress: float
    plastic_viscosity: float = 10.0

    def law_parameters(self) -> tuple[float, ...]:  # noqa: D102
        return self.yield_stress, self.plastic_viscosity

    @property
    def strength(self) -> float:  # noqa: D102
        return self.yield_stress

    def _check(self) -> None:
        self._require("yield_stress", self.yield_stress > 0, "must be positive")
        self._require("plastic_viscosity", self.plastic_viscosity >= 0, "must not be negative")


@register_material("sand")
@dataclass(frozen=True, kw_only=True)
class Sand(Material):
    """Drucker-Prager without cohesion (Klar et al. 2016): heaps, flows, never pulls.

    Attributes:
        friction_angle: internal friction [rad], in (0, pi/2).
    """

    constitutive_law: ClassVar[ConstitutiveLaw] = DRUCKER_PRAGER

    young: float = 3.5e5
    density: float = 1600.0
    friction_angle: float = math.radians(35)

    def law_parameters(self) -> tuple[float, ...]:  # noqa: D102
        sine = math.sin(self.friction_angle)
        return (math.sqrt(2 / 3) * 2 * sine / (3 - sine),)

    @property
    def strength(self) -> float:  # noqa: D102
        return 0.0

    def _check(self) -> None:
        inside = 0 < self.friction_angle < math.pi / 2
        self._require("friction_angle", inside, "must be in (0, pi/2) rad")


@register_material("snow")
@dataclass(frozen=True, kw_only=True)
class Snow(Material):
    """Fixed corotated with clamped stretches and hardening (Stomakhin et al. 2013).

    Attributes:
        critical_compression: strain at which it starts to pack, in (0, 1).
        critical_stretch: strain at which it starts to break, > 0.
        hardening: exponent xi of exp(xi (1 - J_plastic)), >= 0.
    """

    constitutive_law: ClassVar[ConstitutiveLaw] = SNOW

    young: float = 1.4e5
    poisson: float = 0.2
    density: float = 400.0
    critical_compression: float = 2.5e-2
    critical_stretch: float = 7.5e-3
    hardening: float = 10.0

    def law_parameters(self) -> tuple[float, ...]:  # noqa: D102
        return self.critical_compression, self.critical_stretch, self.hardening

    @property
    def strength(self) -> float:  # noqa: D102
        return self.young * self.critical_compression

    def _check(self) -> None:
        inside = 0 < self.critical_compression < 1
        self._require("critical_compression", inside, "must be in (0, 1)")
        self._require("critical_stretch", self.critical_stretch > 0, "must be positive")
        self._require("hardening", self.hardening >= 0, "must not be negative")


@dataclass(frozen=True, kw_only=True)
class Structure(Snow):
    """Thin-walled structure that folds: packs as snow does, and unfolds as easily as paper.

    Up to the length that it had it resists no pull, so that what is springy beside it straightens
    it again; beyond that it holds up to ``critical_stretch``.
    """

    constitutive_law: ClassVar[ConstitutiveLaw] = CRUSH

    critical_stretch: float = 0.1
    hardening: float = 3.5
