"""Material presets: the paper's soft bodies, vehicles with crumple zones, and overrides."""

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
    """Physical values of one object; None uses the preset's or the recorded value.

    Attributes:
        mass: [kg].
        density: density of the filled object [kg/m^3], if ``mass`` is None.
        material: material of the whole object, instead of the preset's regions.
        friction: Coulomb coefficient of its surface.
        restitution: coefficient of restitution on a rigid wall, reached by added viscosity.
        velocity: [3] initial velocity, world frame [m/s]; None for the recorded one.
        angular_velocity: [3] initial angular velocity, world axes [rad/s].
        T_world_object: [4, 4] initial pose; None for the recorded one.
        brake: braked fraction of the wheels' grip, 0 to 1; if None, stationary vehicles are braked
            and moving ones roll until they are hit.
        grid: number of cells along twice its longest edge, as in the paper; None for the preset's.

    Raises:
        PhysicsError: for a value out of range.
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
    """Rules for converting objects to bodies.

    Attributes:
        name: ``paper`` or ``vehicle``.
        spacing: particle spacing [m]; cells are twice as large.
        vehicle_spacing: the same if only vehicles take part; their crumple zones are large enough
            for coarser cells.
        cfl: fraction of a cell that waves may cross in a substep; damped materials allow longer
            substeps than elastic ones.
        friction: friction coefficient between surfaces and on the ground.
        wheels: whether vehicles stand on tyres.
        clearance: height of the wheels below the body of vehicles on tyres [m].
        by_density: whether mass is density times volume instead of the default of the category.
        build: ``build(category, particles, spacing)``, returns materials, the material index of
            each particle, and the particles with their masses; object frame.
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
    """Table II of the paper: homogeneous, fixed corotated, E 2e6 Pa, nu 0.4, rho 200 kg/m^3."""
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
        PhysicsError: for an unknown name.
    """
    if name not in PRESETS:
        raise PhysicsError(f"unknown preset {name!r}; allowed are {', '.join(PRESETS)}")
    return PRESETS[name]


# Overrides of an object's physical values by edits, requests and commands.


def with_values(own: ObjectPhysics, *given: PhysicsValues | None) -> ObjectPhysics:
    """The physical values of an object with overrides; later ones take precedence.

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
    """The single material of the values; None if the category determines the materials."""
    values = {n: fields[n] for n in ("young", "poisson", "density", "yield_stress") if n in fields}
    name = fields.get("material")
    if name is None and values.keys() <= {"density"}:
        return None
    return named_material(name or ("metal" if "yield_stress" in values else "jelly"), **values)


_NAMES = set(PhysicsValues.model_fields)
