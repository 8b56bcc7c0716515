"""What objects are made of: the paper's soft bodies, and vehicles with crumple zones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.rotation import Float
from ..physics.errors import PhysicsError
from ..physics.materials import FixedCorotated, Foam, Material, Snow

Regions = Callable[[Float], NDArray[np.int64]]
"""From places along the length [m] to indices of materials."""
VEHICLES = ("car", "vehicle", "van", "truck", "bus")
CRUMPLE_FRACTION = 0.26
"""Fraction of the length that is crumple zone, at each end."""
BUMPER = 0.35
"""Its outermost part [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectPhysics:
    """What is known of one object; None takes the preset's or the recording's value.

    Attributes:
        mass: [kg].
        material: of the whole object, instead of the preset's regions.
        friction: Coulomb coefficient of its surface.
        restitution: wanted rebound from a rigid wall, reached by added viscosity.
        velocity: [3] at the start, world [m/s]; the recorded one when None.
        angular_velocity: [3] at the start, world [rad/s].
        T_world_object: [4, 4] where it starts; where the recording has it when None.
        brake: fraction of the wheels' grip that is braked, 0 to 1; when None, standing vehicles are
            braked, moving ones roll until they are hit.

    Raises:
        PhysicsError: for a mass, friction, restitution or brake out of its range.
    """

    mass: float | None = None
    material: Material | None = None
    friction: float | None = None
    restitution: float | None = None
    velocity: ArrayLike | None = None
    angular_velocity: ArrayLike | None = None
    T_world_object: ArrayLike | None = None
    brake: float | None = None

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
        if self.mass is not None and not (math.isfinite(self.mass) and self.mass > 0):
            raise PhysicsError(f"mass of an object must be positive [kg], not {self.mass!r}")


@dataclass(frozen=True, kw_only=True)
class Preset:
    """How objects become bodies.

    Attributes:
        name: ``paper`` or ``vehicle``.
        spacing: of particles [m]; cells are twice as large.
        friction: of surfaces against each other and the ground.
        wheels: whether vehicles stand on tyres.
        clearance: height under vehicles on tyres that is wheels, not body [m].
        by_density: whether mass is the material's density times volume, not kilograms per class.
        build: (category, length) -> materials, and a rule for regions along the length.
    """

    name: str
    spacing: float
    friction: float
    wheels: bool
    clearance: float
    by_density: bool
    build: Callable[[str, float], tuple[Sequence[Material], Regions]]


def _paper(category: str, length: float) -> tuple[Sequence[Material], Regions]:
    """Table II of the paper: E 2e6 Pa, nu 0.4, rho 200 kg/m^3, fixed corotated, all through."""
    soft = FixedCorotated(young=2e6, poisson=0.4, density=200.0)
    return (soft,), lambda x: np.zeros(len(x), dtype=np.int64)


def _vehicle(category: str, length: float) -> tuple[Sequence[Material], Regions]:
    """Bumpers and crumple zones at both ends of a stiff cabin; other things are soft foam."""
    if category not in VEHICLES:
        foam = Foam(young=4e5, poisson=0.3, yield_stress=3e4, plastic_viscosity=2e3, viscosity=400)
        return (foam,), lambda x: np.zeros(len(x), dtype=np.int64)
    cabin, crumple = (0.5 - CRUMPLE_FRACTION) * length, length / 2 - BUMPER

    def regions(x: Float) -> NDArray[np.int64]:
        return np.searchsorted([cabin, crumple], np.abs(x))

    return (CABIN, CRUMPLE, BUMPER_FOAM), regions


BUMPER_FOAM = Snow(
    young=2e6,
    poisson=0.0,
    density=150.0,
    critical_compression=0.015,
    critical_stretch=0.05,
    hardening=7.0,
    viscosity=1e3,
)
"""Gives way first, so that even a slow contact costs energy; what it stores before it yields is
what cars of published tests jump back with at walking pace."""
CRUMPLE = Snow(
    young=2.4e7,
    poisson=0.1,
    density=150.0,
    critical_compression=0.0055,
    critical_stretch=0.05,
    hardening=4.0,
    viscosity=6e3,
)
"""Crushes at a stress that grows as it packs, like the fitted force over crush of real fronts."""
CABIN = Snow(
    young=1.2e8,
    poisson=0.2,
    density=150.0,
    critical_compression=0.03,
    critical_stretch=0.06,
    hardening=4.0,
    viscosity=1e4,
)
"""Five times as stiff, and strong enough to stay whole while the ends give way."""

PRESETS = {
    "paper": Preset(
        name="paper",
        spacing=0.1,
        friction=0.5,
        wheels=False,
        clearance=0.0,
        by_density=True,
        build=_paper,
    ),
    "vehicle": Preset(
        name="vehicle",
        spacing=0.1,
        friction=0.4,
        wheels=True,
        clearance=0.12,
        by_density=False,
        build=_vehicle,
    ),
}


def preset_of(name: str) -> Preset:
    """The preset of that name.

    Raises:
        PhysicsError: when there is none.
    """
    if name not in PRESETS:
        raise PhysicsError(f"unknown preset {name!r}; allowed are {', '.join(PRESETS)}")
    return PRESETS[name]
