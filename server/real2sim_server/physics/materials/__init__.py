"""What bodies are made of: frozen, checked records in SI units, found by name.

A material names its constitutive law and says which numbers go into it. New ones register
themselves with :func:`register_material`; a module of this package must be imported here.
"""

from .elastic import FixedCorotated, NearRigid, NeoHookean
from .material import MATERIALS, Material, named_material, register_material
from .plastic import Foam, Metal, Sand, Snow, Structure

__all__ = [
    "MATERIALS",
    "FixedCorotated",
    "Foam",
    "Material",
    "Metal",
    "NearRigid",
    "NeoHookean",
    "Sand",
    "Snow",
    "Structure",
    "named_material",
    "register_material",
]
