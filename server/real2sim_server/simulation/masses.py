"""Default masses of the things on a street."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..physics.errors import ParticleError
from .structure import VEHICLES


@dataclass(frozen=True)
class ClassMass:
    """Default mass of a category.

    A person's mass goes by height, since a tracked box is wider and longer than who walks in it.

    Attributes:
        per_volume: mass per volume of the object's box [kg/m^3].
        source: where the figure comes from.
        person: whether it holds a person as high as the box.
        besides: what comes to a person [kg].
        stability: static stability factor, half the track over the height of the centre of mass;
            None where it lies where the filled shape has it.
        stability_source: where that comes from.
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
CAR = ClassMass(
    125.0,
    "2015 Chevrolet Malibu as tested, 3639 lb in 4.87 x 1.85 x 1.47 m (NHTSA frontal test)",
    stability=1.41,
    stability_source=NHTSA_SSF + ": passenger cars",
)
PERSON = ClassMass(
    270.0,
    "Hybrid III 50th percentile dummy, 78 kg in 1.75 x 0.50 x 0.33 m; otherwise by the 2.5th power "
    "of height (L. N. Trefethen, letter to The Economist, 2013)",
    person=True,
)
PERSON_KG, PERSON_HEIGHT, GROWTH = 78.0, 1.75, 2.5
HEIGHTS = (0.6, 2.0)
"""Of persons [m]; boxes that are lower or higher are wrong."""
CLASS_MASSES = {
    "car": CAR,
    "vehicle": CAR,
    "van": ClassMass(
        115.0,
        "large panel van, about 2000 kg kerb in 5.9 x 2.0 x 1.45 m of box",
        stability=1.12,
        stability_source=NHTSA_SSF + ": full-size vans",
    ),
    "truck": ClassMass(130.0, "two-axle lorry, half laden: about 11 t in 8.5 x 2.5 x 4.0 m"),
    "bus": ClassMass(125.0, "12 m city bus, about 12 t kerb in 12 x 2.55 x 3.1 m"),
    "pedestrian": PERSON,
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
"""Typical figures for want of better ones; give a mass where it is known."""
OTHER = ClassMass(100.0, "between empty furniture and wood; no better guess")


YAW_RADIUS = 0.261
"""Radius of gyration of vehicles about the vertical, over their length: 1538.9 kg m^2 of a Ford
Escort of 1225.9 kg and 4.298 m (CommonRoad vehicle models). The particles of a car have 0.262, a
box of even mass 0.31."""


def yaw_inertia(category: str, mass: float, size: Sequence[float]) -> float:
    """Inertia of an object about the vertical [kg m^2].

    Args:
        category: of the object.
        mass: [kg].
        size: (length, width, ...) of its box [m].
    """
    if category in VEHICLES:
        return mass * (YAW_RADIUS * size[0]) ** 2
    return mass * (size[0] * size[0] + size[1] * size[1]) / 12


def default_mass(category: str, size: Sequence[float], *, by_height: bool = True) -> float:
    """Mass [kg] of an object of that category and box size (length, width, height) [m].

    Args:
        category: of the object.
        size: of its box.
        by_height: persons weigh by their height; False: by the volume of their box, as episodes of
            earlier versions had it.

    Raises:
        ParticleError: for a size that is not three positive lengths.
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
    """Height of the centre of mass above the road [m] of a vehicle with that track [m], by the
    published stability of its class; None for classes without one."""
    stability = CLASS_MASSES.get(category, OTHER).stability
    return None if stability is None else track / (2 * stability)
