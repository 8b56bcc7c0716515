"""Materials of objects: the paper's soft bodies, vehicles with crumple zones, and values over
them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from real2sim_proto.operations import PhysicsValues

from ..physics.body import Particles
from ..physics.errors import PhysicsError
from ..physics.materials import FixedCorotated, Foam, Material, named_material
from .structure import VEHICLES, vehicle_structure

GRID_MIN, GRID_MAX = 16, 1000

Build = tuple[Sequence[Material], NDArray[np.int64], Particles]


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectPhysics:
    """What is known of one object; None takes the preset's or the recording's value.

    Attributes:
        mass: [kg].
        density: of what it is filled with [kg/m^3], where ``mass`` is not given.
        material: of the whole object, instead of the preset's regions.
        friction: Coulomb coefficient of its surface.
        restitution: wanted rebound from a rigid wall, reached by added viscosity.
        velocity: [3] at the start, world [m/s]; the recorded one when None.
        angular_velocity: [3] at the start, world [rad/s].
        T_world_object: [4, 4] where it starts; where the recording has it when None.
        brake: fraction of the wheels' grip that is braked, 0 to 1; when None, standing vehicles are
            braked, moving ones roll until they are hit.
        grid: cells along twice its longest edge, as the paper counts them; the preset's when None.

    Raises:
        PhysicsError: for a value out of its range.
    """

    mass: float | None = None
    density: float | None = None
    material: Material | None = None
    friction: float | None = None
    restitution: float | None = None
    velocity: ArrayLike | None = None
    angular_velocity: ArrayLike | None = None
    T_world_object: ArrayLike | None = None
    brake: float | None = None
    grid: int | None = None

    def __post_init__(self) -> None:
        for name, low, high in (
            ("friction", 0.0, math.inf),
            ("restitution", 0.0, 1.0),
            ("brake", 0.0, 1.0),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                bounds = "not be negative" if high == math.inf else f"be in [{low:g}, {high:g}]"
                raise PhysicsError(f"{name} of an object must {bounds}: {value!r}")
        for name, unit in (("mass", "kg"), ("density", "kg/m^3")):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise PhysicsError(f"{name} of an object must be positive [{unit}], not {value!r}")
        if self.grid is not None and not GRID_MIN <= self.grid <= GRID_MAX:
            raise PhysicsError(
                f"grid of an object must be in [{GRID_MIN}, {GRID_MAX}], not {self.grid!r}"
            )


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A rule that turns objects into bodies.

    Attributes:
        name: ``paper`` or ``vehicle``.
        spacing: of particles [m]; cells are twice as large.
        vehicle_spacing: the same where only vehicles take part: zones of a vehicle are so large
            that they fold alike on coarser cells.
        cfl: fraction of a cell that waves may cross in a substep; what is damped is as stable with
            longer substeps as elastic bodies are with shorter ones.
        friction: of surfaces against each other and the ground.
        wheels: whether vehicles stand on tyres.
        clearance: height under vehicles on tyres that is wheels, not body [m].
        by_density: whether mass is the material's density times volume, not kilograms per class.
        build: (category, particles in the object's frame, their spacing) -> materials, index of
            the material of each particle, and the particles with their masses.
    """

    name: str
    spacing: float
    vehicle_spacing: float
    cfl: float
    friction: float
    wheels: bool
    clearance: float
    by_density: bool
    build: Callable[[str, Particles, float], Build]


def _paper(category: str, particles: Particles, spacing: float) -> Build:
    """Table II of the paper: E 2e6 Pa, nu 0.4, rho 200 kg/m^3, fixed corotated, all through."""
    soft = FixedCorotated(young=2e6, poisson=0.4, density=200.0)
    return (soft,), np.zeros(len(particles), dtype=np.int64), particles


def _vehicle(category: str, particles: Particles, spacing: float) -> Build:
    """Vehicles have crumple zones; other objects are soft foam."""
    if category in VEHICLES:
        return vehicle_structure(category, particles, spacing=spacing)
    foam = Foam(young=4e5, poisson=0.3, yield_stress=3e4, plastic_viscosity=2e3, viscosity=400)
    return (foam,), np.zeros(len(particles), dtype=np.int64), particles


PRESETS = {
    "paper": Preset(
        name="paper",
        spacing=0.1,
        vehicle_spacing=0.1,
        cfl=0.4,
        friction=0.5,
        wheels=False,
        clearance=0.0,
        by_density=True,
        build=_paper,
    ),
    "vehicle": Preset(
        name="vehicle",
        spacing=0.1,
        vehicle_spacing=0.125,
        cfl=0.6,
        friction=0.4,
        wheels=True,
        clearance=0.12,
        by_density=False,
        build=_vehicle,
    ),
}


def preset_of(name: str) -> Preset:
    """The preset with this name.

    Raises:
        PhysicsError: when there is none.
    """
    if name not in PRESETS:
        raise PhysicsError(f"unknown preset {name!r}; allowed are {', '.join(PRESETS)}")
    return PRESETS[name]


# An object's physical values from edits, requests and commands, over known defaults.


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
