"""Structure of objects: crash structure and stiffness of vehicles, masses, material presets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from real2sim_proto.operations import PhysicsValues

from ..geometry import Float
from ..physics.body import Particles
from ..physics.errors import ParticleError, PhysicsError
from ..physics.materials import (
    FixedCorotated,
    Foam,
    Material,
    NeoHookean,
    Snow,
    Structure,
    named_material,
)

# --- Crash structure ------------------------------------------------------------------------------

# A vehicle is a stiff core with yielding zones around it: front and rear, sides (door, sill and B
# pillar together) and roof. Each zone has a force-deflection curve from published tests.
# :func:`vehicle_structure` derives materials whose particles carry the force of their zone; the
# closed loop uses the same values per area of overlap. Front and rear have two layers in series.
# The outer one (bumper, skin, headlamps, attachments) folds at low force and slowly recovers. The
# inner one (rails) keeps its crush. This reproduces a car with 0.6 m dynamic crush, a rebound at a
# fraction of its speed, and 0.26 m residual crush.

M = TypeVar("M", bound=Material)

GRAVITY = 9.81
VEHICLES = ("car", "vehicle", "van", "truck", "bus")


@dataclass(frozen=True, kw_only=True)
class VehicleStructure:
    """Force over deflection of a vehicle class.

    Attributes:
        front, rear, side: force per width and deflection [N/m^2].
        roof: force at 127 mm deflection, in multiples of the vehicle's weight.
        source: source of the values.
    """

    front: float
    rear: float
    side: float
    roof: float
    source: str


CAR = VehicleStructure(
    front=474e3,
    rear=430e3,
    side=870e3,
    roof=3.0,
    source="front: load cells of the 2015 Malibu barrier test, 60127 lb/ft over 1.85 m (NHTSA); "
    "rear: that of a pair of 405 kN/m with such a front (Bonugli et al. 2017); "
    "side: 0.4 m at 8.9 m/s against a pole of 254 mm (FMVSS 214); roof: FMVSS 216a",
)
STRUCTURES = {
    "car": CAR,
    "vehicle": CAR,
    "van": replace(CAR, source="as a car: vans of this mass pass the same barrier tests"),
    "truck": replace(
        CAR, front=1.5e6, rear=1.5e6, side=1.7e6, roof=1.5, source="frame rails; no test"
    ),
    "bus": replace(CAR, front=9e5, rear=9e5, side=1e6, roof=1.5, source="roof: ECE R66; no test"),
}
"""Structure by category."""
PERSON_STIFFNESS, OTHER_STIFFNESS = 6e4, 3e5
"""Stiffness on all sides of persons and of other objects, without tests [N/m^2]."""


def stiffness_of(category: str) -> tuple[float, float, float]:
    """Stiffness of front, rear and sides of a category: force per width and deflection [N/m^2]."""
    if category in STRUCTURES:
        found = STRUCTURES[category]
        return found.front, found.rear, found.side
    person = category in {"pedestrian", "person", "cyclist", "animal"}
    return (PERSON_STIFFNESS if person else OTHER_STIFFNESS,) * 3


END, OUTER = 0.2875, 0.1745
"""Fractions of the length at each end: crumple zone, and its outer layer, which recovers."""
END_HEIGHT = 1.35
"""Height of the section to which the stresses of the ends refer [m], as in the barrier test."""
MIN_SECTION = 0.3
"""Minimum filled height of a section [m]; lower values are due to incomplete recordings."""
OUTER_DENSITY = 0.35
"""Density of the outer layer relative to the rest; engine and axles are behind it."""
ROOF_DENSITY = 0.12
"""Relative density above the belt line: glass, pillars and air."""
SIDE = 0.36
"""Fraction of the width at each side that is door, sill and pillar."""
BELT = 0.5
"""Fraction of the height above which the roof zone begins."""
ROOF_TEST = 0.127
"""Deflection at which roof strength is measured [m] (49 CFR 571.216a)."""
ROOF_HARDENING = 2.0
ROOF_SHARE = 0.75
"""Fraction of the roof's force from its own stress; its edges on the body carry the rest."""
CORE, DOORS, ROOF, ENDS = range(4)
"""Zones; materials of the rear start at ENDS, followed by those of the front."""

CORE_MATERIAL = Snow(
    young=3e7,
    poisson=0.2,
    density=150.0,
    critical_compression=0.05,
    critical_stretch=0.08,
    hardening=4.0,
    viscosity=5e3,
)
"""Survival cell and drivetrain, which stay intact while all other zones yield."""
RAILS_MATERIAL = Snow(
    young=2.27e7,
    poisson=0.0,
    density=150.0,
    critical_compression=0.003,
    critical_stretch=0.05,
    hardening=3.4,
    viscosity=1e3,
)
FOLDS_MATERIAL = Structure(
    young=5e5,
    poisson=0.0,
    density=150.0,
    critical_compression=0.03,
    critical_stretch=0.1,
    hardening=3.4,
    viscosity=20.0,
)
SPRINGS_MATERIAL = NeoHookean(young=4e4, poisson=0.0, density=150.0, viscosity=2.3e3)
"""Half of the outer layer, alternating with folding particles. Its viscosity absorbs the energy
that low-speed restitution does not return."""
END_MATERIALS: tuple[Material, ...] = (RAILS_MATERIAL, FOLDS_MATERIAL, SPRINGS_MATERIAL)
SIDE_STRESS = 0.0855
"""Stress of a side relative to the ends for the same force per width and deflection. A side is
shallower, and an impact also moves the surrounding structure."""


def vehicle_structure(
    category: str, particles: Particles, *, spacing: float, section_height: float | None = None
) -> tuple[tuple[Material, ...], NDArray[np.int64], Particles]:
    """Materials of a vehicle, material index of each particle, and particles with new masses.

    Args:
        category: one of ``STRUCTURES``.
        particles: particles at rest, vehicle frame (x forward, z up); their masses sum to its mass.
        spacing: particle spacing [m].
        section_height: height of the ends if the particles are a central column of the vehicle [m];
            a column has no sides and no roof.
    """
    structure = STRUCTURES[category]
    low = particles.positions.min(axis=0) - spacing / 2
    size = particles.positions.max(axis=0) + spacing / 2 - low
    zones = _zones(
        (particles.positions - low) / size,
        np.floor((particles.positions - low) / spacing),
        column=section_height is not None,
    )
    materials = [CORE_MATERIAL]
    regions = np.zeros(len(zones), dtype=np.int64)
    for zone in np.unique(zones[zones > CORE]).tolist():
        where = zones == zone
        regions[where] = len(materials)
        volume = float(particles.volumes[where].sum())
        if zone == ROOF:
            materials.append(_roof(structure.roof * GRAVITY * particles.mass, volume, size[2]))
        elif zone == DOORS:
            height = volume / (2 * SIDE * (1 - 2 * END) * size[0] * size[1])
            scale = SIDE_STRESS * structure.side / CAR.front * END_HEIGHT / max(height, MIN_SECTION)
            materials.append(_scaled(RAILS_MATERIAL, scale))
        else:
            ahead, kind = divmod(zone - ENDS, len(END_MATERIALS))
            section = section_height or _end_height(particles, zones, ahead, size)
            stiffness = structure.front if ahead else structure.rear
            scale = stiffness / CAR.front * END_HEIGHT / max(section, MIN_SECTION)
            materials.append(_scaled(END_MATERIALS[kind], scale))
    light = (zones >= ENDS) & ((zones - ENDS) % len(END_MATERIALS) > 0)
    masses = particles.masses * np.where(light, OUTER_DENSITY, 1.0)
    masses[zones == ROOF] *= ROOF_DENSITY
    return tuple(materials), regions, replace(particles, masses=masses).with_mass(particles.mass)


def _zones(place: Float, cells: Float, *, column: bool) -> NDArray[np.int64]:
    """Zone of each particle, from positions [N, 3] as fractions of the size and in cells [N, 3]."""
    zones = np.full(len(place), CORE)
    ahead = place[:, 0] > 0.5
    from_end = np.minimum(place[:, 0], 1 - place[:, 0])
    kind = np.where(from_end < OUTER, 1 + cells.sum(axis=1).astype(np.int64) % 2, 0)
    end = ENDS + len(END_MATERIALS) * ahead + kind
    if column:
        return np.where(from_end < END, end, zones)
    zones[np.abs(place[:, 1] - 0.5) > 0.5 - SIDE] = DOORS
    zones = np.where(from_end < END, end, zones)
    zones[place[:, 2] > BELT] = ROOF
    return zones


def _end_height(particles: Particles, zones: NDArray[np.int64], ahead: int, size: Float) -> float:
    """Mean filled height [m] over the plan area of one end."""
    first = ENDS + len(END_MATERIALS) * ahead
    end = (zones >= first) & (zones < first + len(END_MATERIALS))
    return float(particles.volumes[end].sum() / (END * size[0] * size[1]))


def _scaled(material: M, scale: float) -> M:
    return replace(material, young=scale * material.young, viscosity=scale * material.viscosity)


def _roof(force: float, volume: float, height: float) -> Snow:
    """The material of a zone of this volume that carries ``force`` [N] at the test deflection."""
    depth = (1 - BELT) * height
    strain = min(ROOF_TEST / depth, 0.9)
    stress = ROOF_SHARE * force * depth / volume / math.exp(ROOF_HARDENING * strain)
    return Snow(
        young=100 * stress,
        poisson=0.0,
        density=150.0,
        critical_compression=0.01,
        critical_stretch=0.1,
        hardening=ROOF_HARDENING,
        viscosity=50.0,
    )


# Default masses of objects.


@dataclass(frozen=True)
class ClassMass:
    """Default mass of a category.

    The mass of a person depends on the height, because tracked boxes are wider and longer than the
    person inside.

    Attributes:
        per_volume: mass per volume of the object's box [kg/m^3].
        source: source of the value.
        person: whether it includes a person as high as the box.
        besides: mass in addition to the person, such as a bicycle [kg].
        stability: static stability factor, half the track over the height of the centre of mass;
            None to use the centre of mass of the filled shape.
        stability_source: source of that factor.
    """

    per_volume: float
    source: str
    person: bool = False
    besides: float = 0.0
    stability: float | None = None
    stability_source: str = ""


NHTSA_SSF = (
    "sales-weighted average of model year 2003 by the abstract of Trends in the Static Stability "
    "Factor of Passenger Cars, Light Trucks, and Vans, NHTSA DOT HS 809 868 "
    "(https://trid.trb.org/view/763766)"
)
CAR_MASS = ClassMass(
    125.0,
    "2015 Chevrolet Malibu as tested, 3639 lb in 4.87 x 1.85 x 1.47 m (NHTSA frontal test)",
    stability=1.41,
    stability_source=NHTSA_SSF + ": passenger cars",
)
PERSON_MASS = ClassMass(
    270.0,
    "Hybrid III 50th percentile dummy, 78 kg in 1.75 x 0.50 x 0.33 m; otherwise by the 2.5th power "
    "of height (L. N. Trefethen, letter to The Economist, 2013)",
    person=True,
)
PERSON_KG, PERSON_HEIGHT, GROWTH = 78.0, 1.75, 2.5
HEIGHTS = (0.6, 2.0)
"""Valid heights of persons [m]; other boxes are wrong."""
CLASS_MASSES = {
    "car": CAR_MASS,
    "vehicle": CAR_MASS,
    "van": ClassMass(
        115.0,
        "large panel van, about 2000 kg kerb in 5.9 x 2.0 x 1.45 m of box",
        stability=1.12,
        stability_source=NHTSA_SSF + ": full-size vans",
    ),
    "truck": ClassMass(130.0, "two-axle lorry, half laden: about 11 t in 8.5 x 2.5 x 4.0 m"),
    "bus": ClassMass(125.0, "12 m city bus, about 12 t kerb in 12 x 2.55 x 3.1 m"),
    "pedestrian": PERSON_MASS,
    "cyclist": ClassMass(
        85.0,
        "78 kg rider and 14 kg bicycle in 1.8 x 0.6 x 1.0 m of box; the rider's head is about as "
        "high as when walking",
        person=True,
        besides=14.0,
    ),
    "motorcyclist": ClassMass(
        100.0, "rider as for a cyclist, and 200 kg machine", person=True, besides=200.0
    ),
    "motorcycle": ClassMass(150.0, "200 kg machine and 78 kg rider in 2.1 x 0.8 x 1.1 m of box"),
}
"""Typical values by category. Set ``mass`` if you know it."""
OTHER = ClassMass(100.0, "between empty furniture and wood; no better guess")


YAW_RADIUS = 0.261
"""Radius of gyration of vehicles about the vertical axis, relative to their length: 1538.9 kg m^2
of a Ford Escort of 1225.9 kg and 4.298 m (CommonRoad vehicle models). The particles of a car have
0.262, a homogeneous box 0.31."""


def yaw_inertia(category: str, mass: float, size: Sequence[float]) -> float:
    """Inertia of an object about the vertical axis [kg m^2].

    Args:
        category: category of the object.
        mass: [kg].
        size: (length, width, ...) of its box [m].
    """
    if category in VEHICLES:
        return mass * (YAW_RADIUS * size[0]) ** 2
    return mass * (size[0] * size[0] + size[1] * size[1]) / 12


def default_mass(category: str, size: Sequence[float], *, by_height: bool = True) -> float:
    """Default mass [kg] of an object.

    Args:
        category: category of the object.
        size: (length, width, height) of its box [m].
        by_height: whether the mass of a person depends on the height; if False, on the box volume,
            as in episodes of earlier versions.

    Raises:
        ParticleError: if ``size`` is not three positive lengths.
    """
    edges = np.asarray(size, dtype=np.float64)
    if edges.shape != (3,) or not (edges > 0).all():
        raise ParticleError(f"size must be three positive lengths [m], not {size!r}")
    known = CLASS_MASSES.get(category, OTHER)
    if known.person and by_height:
        height = min(max(float(edges[2]), HEIGHTS[0]), HEIGHTS[1])
        return PERSON_KG * math.pow(height / PERSON_HEIGHT, GROWTH) + known.besides
    return known.per_volume * float(edges.prod())


def centre_height(category: str, track: float) -> float | None:
    """Height of a vehicle's centre of mass above the road [m], from its track [m].

    Uses the published static stability factor of its class; None for classes without one.
    """
    stability = CLASS_MASSES.get(category, OTHER).stability
    return None if stability is None else track / (2 * stability)


# --- Presets --------------------------------------------------------------------------------------

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
        vehicle_spacing: the same if all objects are vehicles; their crumple zones are large enough
            for coarser cells.
        cfl: fraction of a cell that waves may cross in a substep; damped materials allow longer
            substeps than elastic ones.
        friction: friction coefficient between surfaces and on the ground.
        wheels: whether vehicles have tyres.
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
    """Vehicles with crumple zones; other objects are soft foam."""
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
