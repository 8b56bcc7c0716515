"""Which constitutive laws there are, and what each of them keeps of a particle.

The functions themselves are in :mod:`.stress`, compiled, and once more in plain torch in
``backends.reference.stress``. Both choose by the code of a law, so a new law is a record here, a
branch in each of the two, and columns of a row in :mod:`.material_row`.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import MaterialError
from . import material_row


@dataclass(frozen=True)
class ConstitutiveLaw:
    """How stress follows from deformation.

    Attributes:
        name: of the law.
        code: what kernels know it by, column LAW of a material's row.
        plastic: whether it flows, so that F_elastic and F_total part ways and history is kept.
        parameters: what the columns A, B and C hold, at most three.
    """

    name: str
    code: int
    plastic: bool
    parameters: tuple[str, ...] = ()


FIXED_COROTATED = ConstitutiveLaw("fixed_corotated", material_row.COROTATED, plastic=False)
NEO_HOOKEAN = ConstitutiveLaw("neo_hookean", material_row.NEO_HOOKEAN, plastic=False)
VON_MISES = ConstitutiveLaw(
    "von_mises", material_row.VON_MISES, plastic=True, parameters=("yield_stress", "hardening")
)
VISCOPLASTIC = ConstitutiveLaw(
    "viscoplastic",
    material_row.VISCOPLASTIC,
    plastic=True,
    parameters=("yield_stress", "plastic_viscosity"),
)
DRUCKER_PRAGER = ConstitutiveLaw(
    "drucker_prager", material_row.DRUCKER_PRAGER, plastic=True, parameters=("cone_slope",)
)
SNOW = ConstitutiveLaw(
    "snow",
    material_row.SNOW,
    plastic=True,
    parameters=("critical_compression", "critical_stretch", "hardening"),
)
CRUSH = ConstitutiveLaw(
    "crush",
    material_row.CRUSH,
    plastic=True,
    parameters=("critical_compression", "critical_stretch", "hardening"),
)
CONSTITUTIVE_LAWS = {
    law.code: law
    for law in (FIXED_COROTATED, NEO_HOOKEAN, VON_MISES, VISCOPLASTIC, DRUCKER_PRAGER, SNOW, CRUSH)
}
"""All laws that kernels know, by code."""


def require_known(law: object, owner: str) -> ConstitutiveLaw:
    """The law itself, where kernels know it.

    Raises:
        MaterialError: for anything else, with what is allowed.
    """
    if not isinstance(law, ConstitutiveLaw) or CONSTITUTIVE_LAWS.get(law.code) != law:
        name = law.name if isinstance(law, ConstitutiveLaw) else law
        raise MaterialError(
            f"unknown constitutive law {name!r} of {owner}; allowed are {allowed_laws()}"
        )
    return law


def law_of_code(code: float) -> ConstitutiveLaw:
    """The law of a code.

    Raises:
        MaterialError: when there is none, with what is allowed.
    """
    law = CONSTITUTIVE_LAWS.get(int(code)) if code == int(code) else None
    if law is None:
        raise MaterialError(f"unknown constitutive law {code!r}; allowed are {allowed_laws()}")
    return law


def allowed_laws() -> str:
    """Names of all laws, for a person."""
    return ", ".join(law.name for law in CONSTITUTIVE_LAWS.values())
