"""What a material is: checked parameters, a constitutive law, a name under which it is found.

Stress is Kirchhoff stress tau of the elastic deformation gradient F; mu = E / 2(1 + nu),
lambda = E nu / (1 + nu)(1 - 2 nu). Every material may be damped by Kelvin-Voigt viscosity:
tau += J eta (L + L^T) with the velocity gradient L.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..constitutive.law import ConstitutiveLaw, require_known
from ..constitutive.material_row import LAMBDA, LAW, MATERIAL_ROW, MU, PLASTIC, VISCOSITY, A
from ..errors import MaterialError


@dataclass(frozen=True, kw_only=True)
class Material:
    """A record of what a body is made of: elastic constants, and those that a subclass adds.

    Attributes:
        constitutive_law: of the class; says which function gives the stress and what is kept.
        young: Young's modulus E [Pa], > 0.
        poisson: Poisson's ratio nu, in (-1, 0.5).
        density: mass per rest volume [kg/m^3], > 0; used where an object's mass is not given.
        viscosity: Kelvin-Voigt eta [Pa s], >= 0.

    Raises:
        MaterialError: for a value outside its range, or a law that kernels do not know.
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
        """Whether it keeps dents, so that F_elastic and F_total part ways."""
        return self.constitutive_law.plastic

    @property
    def strength(self) -> float:
        """Stress at which pressure from one side makes it yield [Pa]; infinite: never."""
        return math.inf

    def row(self) -> NDArray[np.float64]:
        """The record as kernels read it: [MATERIAL_ROW] float64, see ``constitutive.material_row``.

        Raises:
            MaterialError: when there are not as many law parameters as the law has.
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
        """What the law needs besides elastic constants, in the order of its ``parameters``."""
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


MATERIALS: dict[str, Callable[[], Material]] = {}
"""Materials by the names that operations know them by, each with typical numbers."""
_Kind = TypeVar("_Kind", bound=type[Material])


def register_material(name: str, **typical: float) -> Callable[[_Kind], _Kind]:
    """Decorator: makes a material known by a name.

    Args:
        name: unique among all materials.
        typical: parameters of what the name stands for, where they are not the class's defaults.

    Raises:
        MaterialError: for a name that is taken.
    """

    def register(kind: _Kind) -> _Kind:
        if name in MATERIALS:
            raise MaterialError(f"a material {name!r} is there already; take another name")
        MATERIALS[name] = functools.partial(kind, **typical)
        return kind

    return register


def named_material(name: str, **values: float) -> Material:
    """The material that a name stands for, with these values in place of its own.

    Raises:
        MaterialError: for a name nobody registered, with what is allowed; for a value that the
            material does not have, or outside its range.
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
