"""What bodies are made of. Frozen, checked, in SI units.

Stress is Kirchhoff stress tau of the elastic deformation gradient F; mu = E / 2(1 + nu),
lambda = E nu / (1 + nu)(1 - 2 nu). Every material may be damped by Kelvin-Voigt viscosity:
tau += J eta (L + L^T) with the velocity gradient L.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .constitutive import stress as laws
from .errors import MaterialError


@dataclass(frozen=True, kw_only=True)
class Material:
    """Elastic constants that all materials share.

    Attributes:
        young: Young's modulus E [Pa], > 0.
        poisson: Poisson's ratio nu, in (-1, 0.5).
        density: mass per rest volume [kg/m^3], > 0; used where an object's mass is not given.
        viscosity: Kelvin-Voigt eta [Pa s], >= 0.

    Raises:
        MaterialError: for a value outside its range.
    """

    young: float
    poisson: float = 0.3
    density: float = 200.0
    viscosity: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, self._number(field.name))
        self._require("young", self.young > 0, "must be positive")
        self._require(
            "poisson",
            -1 < self.poisson < 0.5,
            "must be in (-1, 0.5); 0.5 is incompressible and has no finite stiffness, take 0.45",
        )
        self._require("density", self.density > 0, "must be positive")
        self._require("viscosity", self.viscosity >= 0, "must not be negative")
        self._check()

    @property
    def shear_modulus(self) -> float:
        """Mu [Pa]."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def lame_lambda(self) -> float:
        """Lambda [Pa]."""
        return self.young * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))

    @property
    def wave_modulus(self) -> float:
        """Lambda + 2 mu [Pa]: rho c^2 of pressure waves."""
        return self.lame_lambda + 2 * self.shear_modulus

    @property
    def wave_speed(self) -> float:
        """Speed of pressure waves at the material's own density [m/s]."""
        return math.sqrt(self.wave_modulus / self.density)

    @property
    def plastic(self) -> bool:
        """Whether it keeps dents, so that F_elastic and F_total part ways."""
        return self._kind() not in (laws.COROTATED, laws.NEO_HOOKEAN)

    def row(self) -> NDArray[np.float64]:
        """Parameters as kernels read them: [ROW] float64, columns named in ``laws.stress``."""
        elastic = (self.shear_modulus, self.lame_lambda, self.viscosity)
        extra = (*self._extra(), 0.0, 0.0, 0.0)[: laws.ROW - 4]
        return np.array([self._kind(), *elastic, *extra], dtype=np.float64)

    def _kind(self) -> int:
        raise NotImplementedError

    def _extra(self) -> tuple[float, ...]:
        return ()

    def _check(self) -> None:
        """Check what a subclass adds."""

    def _number(self, name: str) -> float:
        value = getattr(self, name)
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        self._require(name, math.isfinite(number), "must be a finite number")
        return number

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            kind = type(self).__name__
            raise MaterialError(f"{name} of {kind} {what}, not {getattr(self, name)!r}")


@dataclass(frozen=True, kw_only=True)
class FixedCorotated(Material):
    """Fixed corotated elasticity (Stomakhin et al. 2012): soft bodies, and the paper's cars.

    Psi = mu |F - R|^2 + lambda/2 (J - 1)^2.
    """

    def _kind(self) -> int:
        return laws.COROTATED


@dataclass(frozen=True, kw_only=True)
class NearRigid(Material):
    """Fixed corotated and stiff: bends by less than can be seen, at the cost of small steps."""

    young: float = 5e7
    poisson: float = 0.3
    density: float = 500.0

    def _kind(self) -> int:
        return laws.COROTATED


@dataclass(frozen=True, kw_only=True)
class NeoHookean(Material):
    """Compressible neo-Hookean rubber (Bonet and Wood 2008, 6.4); no polar decomposition.

    Psi = mu/2 (tr F^T F - 3) - mu ln J + lambda/2 ln^2 J.
    """

    def _kind(self) -> int:
        return laws.NEO_HOOKEAN


@dataclass(frozen=True, kw_only=True)
class Metal(Material):
    """Hencky elasticity with von Mises yield and linear hardening: keeps dents.

    Attributes:
        yield_stress: uniaxial yield stress [Pa], > 0.
        hardening: tangent modulus of plastic flow [Pa], >= 0.
    """

    yield_stress: float
    hardening: float = 0.0

    def _kind(self) -> int:
        return laws.VON_MISES

    def _extra(self) -> tuple[float, ...]:
        return self.yield_stress, self.hardening

    def _check(self) -> None:
        self._require("yield_stress", self.yield_stress > 0, "must be positive")
        self._require("hardening", self.hardening >= 0, "must not be negative")


@dataclass(frozen=True, kw_only=True)
class Foam(Material):
    """Hencky elasticity with viscoplastic flow (Yue et al. 2015).

    Attributes:
        yield_stress: below this it is elastic [Pa], > 0.
        plastic_viscosity: how slowly it flows above [Pa s], >= 0.
    """

    yield_stress: float
    plastic_viscosity: float = 10.0

    def _kind(self) -> int:
        return laws.VISCOPLASTIC

    def _extra(self) -> tuple[float, ...]:
        return self.yield_stress, self.plastic_viscosity

    def _check(self) -> None:
        self._require("yield_stress", self.yield_stress > 0, "must be positive")
        self._require("plastic_viscosity", self.plastic_viscosity >= 0, "must not be negative")


@dataclass(frozen=True, kw_only=True)
class Sand(Material):
    """Drucker-Prager without cohesion (Klar et al. 2016): heaps, flows, never pulls.

    Attributes:
        friction_angle: internal friction [rad], in (0, pi/2).
    """

    young: float = 3.5e5
    density: float = 1600.0
    friction_angle: float = math.radians(35)

    def _kind(self) -> int:
        return laws.DRUCKER_PRAGER

    def _extra(self) -> tuple[float, ...]:
        sine = math.sin(self.friction_angle)
        return (math.sqrt(2 / 3) * 2 * sine / (3 - sine),)

    def _check(self) -> None:
        inside = 0 < self.friction_angle < math.pi / 2
        self._require("friction_angle", inside, "must be in (0, pi/2) rad")


@dataclass(frozen=True, kw_only=True)
class Snow(Material):
    """Fixed corotated with clamped stretches and hardening (Stomakhin et al. 2013).

    Attributes:
        critical_compression: strain at which it starts to pack, in (0, 1).
        critical_stretch: strain at which it starts to break, > 0.
        hardening: exponent xi of exp(xi (1 - J_plastic)), >= 0.
    """

    young: float = 1.4e5
    poisson: float = 0.2
    density: float = 400.0
    critical_compression: float = 2.5e-2
    critical_stretch: float = 7.5e-3
    hardening: float = 10.0

    def _kind(self) -> int:
        return laws.SNOW

    def _extra(self) -> tuple[float, ...]:
        return self.critical_compression, self.critical_stretch, self.hardening

    def _check(self) -> None:
        inside = 0 < self.critical_compression < 1
        self._require("critical_compression", inside, "must be in (0, 1)")
        self._require("critical_stretch", self.critical_stretch > 0, "must be positive")
        self._require("hardening", self.hardening >= 0, "must not be negative")
