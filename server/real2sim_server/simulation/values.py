"""Values of an object's physics, as edits, requests and commands give them, over what is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from real2sim_proto.operations import PhysicsValues

from ..physics.materials import Material, named_material
from .presets import ObjectPhysics


def with_values(own: ObjectPhysics, *given: PhysicsValues | None) -> ObjectPhysics:
    """What is known of an object, with the values that are given in place of those; later ones go
    before earlier ones.

    Raises:
        MaterialError: for a value that the material does not have.
    """
    fields: dict[str, Any] = {}
    for values in given:
        new = {} if values is None else values.model_dump(include=_NAMES, exclude_none=True)
        for one, other in (("mass", "density"), ("density", "mass")):
            if one in new:
                fields.pop(other, None)
        fields |= new
    changed: dict[str, Any] = {
        name: fields[name] for name in ("friction", "restitution", "grid") if name in fields
    }
    if "mass" in fields or "density" in fields:
        changed |= {"mass": fields.get("mass"), "density": fields.get("density")}
    material = _material(fields)
    return (
        replace(own, **changed) if material is None else replace(own, **changed, material=material)
    )


def _material(fields: dict[str, Any]) -> Material | None:
    """The one material that values ask for; None where they leave that to the category."""
    values = {n: fields[n] for n in ("young", "poisson", "density", "yield_stress") if n in fields}
    name = fields.get("material")
    if name is None and values.keys() <= {"density"}:
        return None
    return named_material(name or ("metal" if "yield_stress" in values else "jelly"), **values)


_NAMES = set(PhysicsValues.model_fields)
