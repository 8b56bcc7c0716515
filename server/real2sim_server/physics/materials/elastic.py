"""Materials that go back to their shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..constitutive.law import FIXED_COROTATED, NEO_HOOKEAN, ConstitutiveLaw
from .material import Material, register_material


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
    """Fixed corotated and stiff: bends by less than can be seen, at the cost of small steps."""

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
