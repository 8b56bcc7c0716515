"""Materials: frozen, validated records in SI units, registered by name.

A material names its constitutive law and provides its parameters. Register new materials with
:func:`register_material`. Constitutive laws are implemented twice: compiled in :mod:`.stress` and
in plain torch in ``backends.reference_laws``. Both dispatch on the code of a law. To add a law, add
a record here, a branch in both implementations, and columns of a material's row.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from . import stress
from .errors import MaterialError
from .stress import LAMBDA, LAW, MATERIAL_ROW, MU, PLASTIC, VISCOSITY, A

# Constitutive laws: name, code and per-particle memory.


@dataclass(frozen=True)
class ConstitutiveLaw:
    """A constitutive law.

    Attributes:
        name: name of the law.
        code: code in kernels, column LAW of a material's row.
        plastic: whether it flows, so that F_elastic and F_total differ and history is stored.
        parameters: parameters in the columns A, B and C, at most three.
    """

    name: str
    code: int
    plastic: bool
    parameters: tuple[str, ...] = ()


FIXED_COROTATED = ConstitutiveLaw("fixed_corotated", stress.COROTATED, plastic=False)
NEO_HOOKEAN = ConstitutiveLaw("neo_hookean", stress.NEO_HOOKEAN, plastic=False)
VON_MISES = ConstitutiveLaw(
    "von_mises", stress.VON_MISES, plastic=True, parameters=("yield_stress", "hardening")
)
VISCOPLASTIC = ConstitutiveLaw(
    "viscoplastic",
    stress.VISCOPLASTIC,
    plastic=True,
    parameters=("yield_stress", "plastic_viscosity"),
)
DRUCKER_PRAGER = ConstitutiveLaw(
    "drucker_prager", stress.DRUCKER_PRAGER, plastic=True, parameters=("cone_slope",)
)
SNOW = ConstitutiveLaw(
    "snow",
    stress.SNOW,
    plastic=True,
    parameters=("critical_compression", "critical_stretch", "hardening"),
)
CRUSH = ConstitutiveLaw(
    "crush",
    stress.CRUSH,
    plastic=True,
    parameters=("critical_compression", "critical_stretch", "hardening"),
)
CONSTITUTIVE_LAWS = {
    law.code: law
    for law in (FIXED_COROTATED, NEO_HOOKEAN, VON_MISES, VISCOPLASTIC, DRUCKER_PRAGER, SNOW, CRUSH)
}
"""All laws of the kernels, by code."""


def require_known(law: object, owner: str) -> ConstitutiveLaw:
    """Return ``law`` if it is a known constitutive law.

    Raises:
        MaterialError: for anything else, with the allowed laws.
    """
    if not isinstance(law, ConstitutiveLaw) or CONSTITUTIVE_LAWS.get(law.code) != law:
        name = law.name if isinstance(law, ConstitutiveLaw) else law
        raise MaterialError(
            f"unknown constitutive law {name!r} of {owner}; allowed are {allowed_laws()}"
        )
    return law


def law_of_code(code: float) -> ConstitutiveLaw:
    """The law with this code.

    Raises:
        MaterialError: for an unknown code, with the allowed laws.
    """
    law = CONSTITUTIVE_LAWS.get(int(code)) if code == int(code) else None
    if law is None:
        raise MaterialError(f"unknown constitutive law {code!r}; allowed are {allowed_laws()}")
    return law


def allowed_laws() -> str:
    """Names of all laws, for error messages."""
    return ", ".join(law.name for law in CONSTITUTIVE_LAWS.values())


@dataclass(frozen=True, kw_only=True)
class Material:
    """Material of a body: elastic constants, and parameters of subclasses.

    Attributes:
        constitutive_law: constitutive law of the class.
        young: Young's modulus E [Pa], > 0.
        poisson: Poisson's ratio nu, in (-1, 0.5).
        density: mass per rest volume [kg/m^3], > 0; used if an object's mass is not given.
        viscosity: Kelvin-Voigt eta [Pa s], >= 0.

    Raises:
        MaterialError: for a value out of range, or an unknown law.
    """

    constitutive_law: ClassVar[ConstitutiveLaw]

    young: float
    poisson: float = 0.3
    density: float = 200.0
    viscosity: float = 0.0

    def __post_init__(self) -> None:
        kind = type(self)
        require_known(getattr(kind, "constitutive_law", None), kind.__name__)
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
        """Whether it deforms plastically, so that F_elastic and F_total differ."""
        return self.constitutive_law.plastic

    @property
    def strength(self) -> float:
        """Uniaxial compressive yield stress [Pa]; infinite if it never yields."""
        return math.inf

    def row(self) -> NDArray[np.float64]:
        """The kernel form: [MATERIAL_ROW] float64, see ``stress.MATERIAL_ROW``.

        Raises:
            MaterialError: if the number of parameters does not match the law.
        """
        law, parameters = self.constitutive_law, self.law_parameters()
        if len(parameters) != len(law.parameters):
            raise MaterialError(
                f"{type(self).__name__} gives {len(parameters)} parameters to the law "
                f"{law.name!r}; it takes {len(law.parameters)}: {', '.join(law.parameters)}"
            )
        row = np.zeros(MATERIAL_ROW)
        row[LAW], row[PLASTIC] = law.code, law.plastic
        row[MU], row[LAMBDA], row[VISCOSITY] = self.shear_modulus, self.lame_lambda, self.viscosity
        row[A : A + len(parameters)] = parameters
        return row

    def law_parameters(self) -> tuple[float, ...]:
        """Parameters of the law besides elastic constants, in the order of its ``parameters``."""
        return ()

    def _check(self) -> None:
        """Validate the parameters of a subclass."""

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


MATERIALS: dict[str, Callable[[], Material]] = {}
"""Named materials with typical parameters."""
_Kind = TypeVar("_Kind", bound=type[Material])


def register_material(name: str, **typical: float) -> Callable[[_Kind], _Kind]:
    """Decorator that registers a material under a name.

    Args:
        name: unique name.
        typical: parameters of the named material that differ from the defaults of the class.

    Raises:
        MaterialError: if the name is taken.
    """

    def register(kind: _Kind) -> _Kind:
        if name in MATERIALS:
            raise MaterialError(f"a material {name!r} is there already; take another name")
        MATERIALS[name] = functools.partial(kind, **typical)
        return kind

    return register


def named_material(name: str, **values: float) -> Material:
    """The material registered under a name, with the given values replaced.

    Raises:
        MaterialError: the name is unknown (the message lists the allowed ones), the material has
            no such parameter, or a value is out of range.
    """
    if name not in MATERIALS:
        raise MaterialError(f"unknown material {name!r}; allowed are {', '.join(MATERIALS)}")
    make = MATERIALS[name]
    known = {field.name for field in fields(make())}
    unknown = sorted(values.keys() - known)
    if unknown:
        raise MaterialError(
            f"material {name!r} has no {unknown[0]}; it has {', '.join(sorted(known))}"
        )
    return make(**values)


# Elastic materials.


@register_material("jelly", young=2e6, poisson=0.4, density=200.0)
@dataclass(frozen=True, kw_only=True)
class FixedCorotated(Material):
    """Fixed corotated elasticity (Stomakhin et al. 2012): soft bodies, and the paper's cars.

    ``Psi = mu |F - R|^2 + lambda/2 (J - 1)^2``.
    """

    constitutive_law: ClassVar[ConstitutiveLaw] = FIXED_COROTATED


@register_material("rigid")
@dataclass(frozen=True, kw_only=True)
class NearRigid(Material):
    """Stiff fixed corotated elasticity: no visible deformation, at the cost of small time steps."""

    constitutive_law: ClassVar[ConstitutiveLaw] = FIXED_COROTATED

    young: float = 5e7
    poisson: float = 0.3
    density: float = 500.0


@register_material("rubber", young=3e6, poisson=0.45, density=1100.0)
@dataclass(frozen=True, kw_only=True)
class NeoHookean(Material):
    """Compressible neo-Hookean rubber (Bonet and Wood 2008, 6.4); no polar decomposition.

    Psi = mu/2 (tr F^T F - 3) - mu ln J + lambda/2 ln^2 J.
    """

    constitutive_law: ClassVar[ConstitutiveLaw] = NEO_HOOKEAN


# Plastic materials: they flow, pack or break.


@register_material("metal", young=2e8, density=300.0, yield_stress=4e6, hardening=2e7)
@dataclass(frozen=True, kw_only=True)
class Metal(Material):
    """Hencky elasticity with von Mises yield and linear hardening: keeps dents.

    The registered material is a car body's sheet metal, averaged over its volume.

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
        yield_stress: elastic limit [Pa], > 0.
        plastic_viscosity: viscosity of plastic flow [Pa s], >= 0.
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
    """Drucker-Prager without cohesion (Klar et al. 2016): heaps and flows, without tension.

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
    """Thin-walled structure that folds: packs like snow and unfolds without resistance.

    Up to its original length it does not resist tension, so neighbouring elastic material can
    straighten it. Beyond that it holds up to ``critical_stretch``.
    """

    constitutive_law: ClassVar[ConstitutiveLaw] = CRUSH

    critical_stretch: float = 0.1
    hardening: float = 3.5
