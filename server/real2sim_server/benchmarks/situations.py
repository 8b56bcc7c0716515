"""What crashes and rolling vehicles cost, whole: matter, rigid motion, contacts and tyres together.

Bodies are the ``vehicle`` preset's, on a road, at the step of every simulation.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..geometry.transform import Float, transform_from
from ..physics.body import box_particles
from ..physics.colliders import Plane
from ..simulation.body import DeformableBody
from ..simulation.presets import preset_of
from ..simulation.simulator import STEP, HybridSimulator
from ..simulation.structure import GRAVITY
from ..simulation.tyres import Tyres

CAR, CAR_MASS = (4.5, 1.8, 1.5), 1500.0
TRUCK, TRUCK_MASS = (8.0, 2.5, 3.2), 20_000.0
CONE, CONE_MASS = (0.4, 0.4, 0.7), 3.0
SPACING, CONE_SPACING = 0.125, 0.1
"""Of particles of vehicles, and of the cone's [m]."""
CLEARANCE = 0.25
"""Of bodies above the road: the wheels' [m]."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def _two_cars() -> list[DeformableBody]:
    """One at 15 m/s into the rear of another that stands."""
    standing = _vehicle("standing", "car", CAR, CAR_MASS, (CAR[0] + 0.05, 0.0))
    return [_vehicle("running", "car", CAR, CAR_MASS, (0.0, 0.0), speed=15.0), standing]


def _truck_and_cone() -> list[DeformableBody]:
    """A truck at 8 m/s throws a cone aside."""
    place = (TRUCK[0] + CONE[0]) / 2 + 0.2, 0.6, CONE[2] / 2
    cone = _body("cone", "cone", CONE, CONE_MASS, place, spacing=CONE_SPACING)
    truck = _vehicle("truck", "truck", TRUCK, TRUCK_MASS, (0.0, 0.0), speed=8.0, spacing=0.25)
    return [truck, cone]


def _car_on_a_car() -> list[DeformableBody]:
    """A car comes down on the roof of another from 5 cm above it."""
    return [
        _vehicle("under", "car", CAR, CAR_MASS, (0.0, 0.0)),
        _vehicle("over", "car", CAR, CAR_MASS, (0.3, 0.0), above=CAR[2] + 0.05),
    ]


def _rolling() -> list[DeformableBody]:
    """A car at 10 m/s that nothing brakes."""
    return [_vehicle("rolling", "car", CAR, CAR_MASS, (0.0, 0.0), speed=10.0, brake=0.0)]


SITUATIONS: dict[str, tuple[Callable[[], list[DeformableBody]], float, float]] = {
    "two cars at 15 m/s, 2 s": (_two_cars, 2.0, 8.0),
    "truck and cone, 1 s": (_truck_and_cone, 1.0, 3.0),
    "car on a car, 3 s": (_car_on_a_car, 3.0, 10.0),
    "a car that rolls, 1 s": (_rolling, 1.0, 0.02),
}
"""By name: the bodies, how long they are followed [s], and in what time they should be [s]."""


def measure(name: str) -> dict[str, Any]:
    """Elapsed and processor time of a situation [s], once all it needs is compiled."""
    build, seconds, target = SITUATIONS[name]
    _follow(build(), seconds=0.15)
    world = _world(build())
    begin, used = time.perf_counter(), time.process_time()
    _advance(world, seconds)
    elapsed, processor = time.perf_counter() - begin, time.process_time() - used
    return {
        "name": name,
        "particles": sum(len(b.rest) for b in world.bodies),
        "simulated_s": seconds,
        "elapsed_s": elapsed,
        "processor_s": processor,
        "target_s": target,
    }


def as_row(line: dict[str, Any]) -> str:
    """A line for a person."""
    unit, factor = ("s", 1.0) if line["target_s"] >= 1 else ("ms", 1e3)
    shown = [f"{factor * line[k]:.3g} {unit}" for k in ("elapsed_s", "processor_s", "target_s")]
    return f"{shown[0]}, {shown[1]} of processors; {shown[2]} wanted"


def _follow(bodies: Sequence[DeformableBody], *, seconds: float) -> None:
    _advance(_world(bodies), seconds)


def _world(bodies: Sequence[DeformableBody]) -> HybridSimulator:
    return HybridSimulator(
        bodies,
        [Plane(name="road", friction=0.7)],
        road=["road"],
        gravity=(0.0, 0.0, -GRAVITY),
        backend="cpu",
        brake_after_hit=1.0,
    )


def _advance(world: HybridSimulator, seconds: float) -> None:
    for _ in range(round(seconds / STEP)):
        world.advance(STEP)


def _vehicle(
    name: str,
    category: str,
    size: tuple[float, float, float],
    mass: float,
    place: tuple[float, float],
    *,
    speed: float = 0.0,
    brake: float = 1.0,
    above: float = 0.0,
    spacing: float = SPACING,
) -> DeformableBody:
    """On its wheels, or ``above`` where it would stand [m]."""
    at = (*place, size[2] / 2 + above)
    body = _body(name, category, size, mass, at, spacing=spacing, clearance=CLEARANCE, speed=speed)
    centre: Float = body.rest.centre_of_mass
    body.tyres = Tyres.of(size, centre, GRAVITY * mass, brake=brake)
    return body


def _body(
    name: str,
    category: str,
    size: tuple[float, float, float],
    mass: float,
    at: tuple[float, float, float],
    *,
    spacing: float,
    clearance: float = 0.0,
    speed: float = 0.0,
) -> DeformableBody:
    """A block of the preset's structure, filled from ``clearance`` above its underside up [m]."""
    lifted = transform_from(np.array([0.0, 0.0, clearance / 2]), np.array(UPRIGHT))
    block = box_particles((*size[:2], size[2] - clearance), spacing=spacing, density=1.0)
    filled = block.with_mass(mass).moved(lifted)
    preset = preset_of("vehicle")
    materials, regions, particles = preset.build(category, filled, spacing)
    return DeformableBody(
        name,
        particles,
        materials,
        regions,
        friction=preset.friction,
        cell=2 * spacing,
        T_world_object=transform_from(np.array(at), np.array(UPRIGHT)),
        velocity=np.array([speed, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
    )
