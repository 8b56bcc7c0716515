"""The vehicle preset against published crash figures.

Sources: frontal barrier tests of the 2015 Chevrolet Malibu (NHTSA, as in joe-cormier/pycrash):
1651 kg, 56.5 km/h, 10.1 in mean residual crush, restitution 0.013. Restitution over impact speed:
Cipriani et al. 2002, e = .47477 - .26139 L + .03382 L^2 - .11639 L^3 with L = log10(v / (m/s)).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ...geometry.rotation import Float
from ...physics.colliders import Plane
from ...physics.particles import box_particles
from ...physics.validation.check import Check
from ..body import DeformableBody
from ..presets import ObjectPhysics, preset_of
from ..rollout import SimulateOptions, simulate_bodies

MALIBU_MASS = 1651.0
MALIBU_SIZE = (4.87, 1.85, 1.35)
"""Length and width of the car, height of its body above the wheels [m]."""
COLUMN = (0.4, 0.4)
"""Width and height of the part of it that is simulated, with its fraction of the mass [m]. Nothing
differs across a block that meets a wall squarely: the whole section gives the same restitutions and
the same crush to a millimetre, and takes sixteen times as long."""
MALIBU_SPEED = 56.5 / 3.6
MALIBU_CRUSH = 0.2565
SPEEDS = (1.0, 2.24, 4.47, 8.94)
SPREAD = 0.15
"""Published restitutions at one speed lie this far apart (SAE 931842: 0.2 to 0.4 at low speed)."""
FACE = 0.2
"""The front and what stays of the cabin are averaged over this depth [m]."""


@dataclass(frozen=True)
class BarrierTest:
    """What one car at a rigid wall did.

    Attributes:
        speed: of approach [m/s].
        crush: mean residual crush of the front [m].
        restitution: separation over approach speed.
        energy_peak: largest total energy over the first, which no crash may raise.
    """

    speed: float
    crush: float
    restitution: float
    energy_peak: float


def block_car(
    name: str = "car",
    *,
    mass: float = MALIBU_MASS,
    x: float = 0.0,
    speed: float = 0.0,
    heading: float = 1.0,
) -> DeformableBody:
    """A column of a car of the vehicle preset, along x; ``heading`` 1 or -1.

    Args:
        name: of the body.
        mass: of the whole car [kg]; the column has its fraction.
        x: of its middle [m].
        speed: [m/s].
        heading: which way its front points, 1 or -1 along x.
    """
    preset = preset_of("vehicle")
    fraction = float(np.prod(COLUMN) / np.prod(MALIBU_SIZE[1:]))
    block = box_particles((MALIBU_SIZE[0], *COLUMN), spacing=preset.spacing, density=1.0)
    particles = block.with_mass(mass * fraction)
    materials, regions = preset.build("car", MALIBU_SIZE[0])
    pose = np.diag([heading, heading, 1.0, 1.0])
    pose[0, 3] = x
    return DeformableBody(
        name,
        particles,
        materials,
        regions(particles.positions[:, 0]),
        friction=preset.friction,
        cell=2 * preset.spacing,
        T_world_object=pose,
        velocity=np.array([speed, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
    )


def barrier_test(speed: float, backend: str) -> BarrierTest:
    """The car of the Malibu test against a rigid wall at ``speed`` [m/s]."""
    car = block_car(speed=speed)
    wall = Plane(
        name="wall", point=(MALIBU_SIZE[0] / 2 + 0.05, 0, 0), normal=(-1, 0, 0), friction=0.3
    )
    options = SimulateOptions(
        objects={"car": ObjectPhysics()},
        colliders=[wall],
        duration=0.05 / speed + 0.25,
        gravity=(0.0, 0.0, 0.0),
        backend=backend,
    )
    result = simulate_bodies([car], options)
    own = result.objects["car"]
    rest = own.rest.astype(np.float64)
    moved = np.zeros_like(rest) if not len(own.shapes) else own.shapes[-1].astype(np.float64)
    total = result.energies[:, :3].sum(axis=1)
    return BarrierTest(
        speed,
        _crush(rest, moved),
        float(-own.velocities[-1, 0] / speed),
        float(total.max() / total[0]),
    )


def _crush(rest: Float, moved: Float) -> float:
    """How far the front came towards the middle of the car, on average [m]."""
    x = rest[:, 0]
    front, middle = x > x.max() - FACE, np.abs(x) < FACE
    return float(moved[middle, 0].mean() - moved[front, 0].mean())


def cipriani(speed: float) -> float:
    """Published mean restitution of cars at an impact speed [m/s]."""
    logarithm = np.log10(speed)
    return float(np.polyval([-0.11639, 0.03382, -0.26139, 0.47477], logarithm))


def malibu(backend: str) -> list[Check]:
    """Frontal crush of the barrier test, within 25 %."""
    return malibu_checks(barrier_test(MALIBU_SPEED, backend))


def malibu_checks(test: BarrierTest) -> list[Check]:
    """A test at the published speed against the published figures."""
    return [
        Check("Malibu frontal crush", test.crush, MALIBU_CRUSH, 0.25 * MALIBU_CRUSH, "m"),
        Check("Malibu restitution", test.restitution, 0.013, SPREAD),
        Check("largest energy over the first", test.energy_peak, 1.0, 1e-3),
    ]


def restitution_by_speed(backend: str) -> list[Check]:
    """Restitution from walking pace to 32 km/h, within the published spread and falling."""
    tests = [barrier_test(speed, backend) for speed in SPEEDS]
    checks = [
        Check(f"restitution at {t.speed:.2f} m/s", t.restitution, cipriani(t.speed), SPREAD)
        for t in tests
    ]
    drops = [a.restitution - b.restitution for a, b in pairwise(tests)]
    return [*checks, Check("steps at which it falls", sum(d > 0 for d in drops), len(drops), 0)]


def collinear_pair(backend: str) -> list[Check]:
    """Delta-v of a car into a standing lighter one, within 5 % of momentum theory.

    dV1 = m2 / (m1 + m2) (1 + e) Vc with the e that came out.
    """
    heavy, light, speed = 1651.0, 1200.0, 8.0
    gap = MALIBU_SIZE[0] + 0.15
    bodies = [
        block_car("striker", mass=heavy, speed=speed),
        block_car("struck", mass=light, x=gap),
    ]
    options = SimulateOptions(
        objects={b.name: ObjectPhysics() for b in bodies},
        duration=0.4,
        gravity=(0.0, 0.0, 0.0),
        backend=backend,
    )
    result = simulate_bodies(bodies, options)
    after = {name: float(o.velocities[-1, 0]) for name, o in result.objects.items()}
    e = (after["struck"] - after["striker"]) / speed
    theory = speed * (1 + e) / (heavy + light)
    return [
        Check(
            "delta-v of the striker",
            speed - after["striker"],
            light * theory,
            0.05 * light * theory,
            "m/s",
        ),
        Check(
            "delta-v of the struck", after["struck"], heavy * theory, 0.05 * heavy * theory, "m/s"
        ),
        Check("restitution of the pair", e, cipriani(speed), SPREAD),
    ]


PUBLISHED = {f.__name__: f for f in (malibu, restitution_by_speed, collinear_pair)}
"""Cases by name; ``real2sim validate --cases published`` runs them."""
