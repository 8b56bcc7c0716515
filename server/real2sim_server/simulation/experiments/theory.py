"""Bodies of a simulation against theory: on tyres, from rigid to deforming and back, at a post."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...physics.body import box_particles
from ...physics.colliders import Box, Plane
from ...physics.materials import FixedCorotated
from ...physics.validation.check import Check, ReferenceCurve, placed
from ..body import BodyMode, DeformableBody
from ..presets import ObjectPhysics
from ..rollout import SimulateOptions, simulate_bodies
from ..structure import GRAVITY
from ..tyres import Tyres
from .crash_tests import CAR_SIZE, MALIBU_MASS, whole_car

GRIP = 0.7
POST = 0.1
"""Edge of a post, a third of a cell of what meets it [m]."""


def tyre_braking(backend: str) -> list[Check]:
    """A car with locked wheels slides v^2 / (2 mu g) in v / (mu g), and is no rigid block."""
    speed = 10.0
    road = Plane(name="ground", friction=GRIP)
    centre = whole_car().rest.centre_of_mass
    tyres = Tyres.of(CAR_SIZE, centre, MALIBU_MASS * GRAVITY, friction=GRIP, brake=1.0)
    place = (0.0, 0.0, CAR_SIZE[2] / 2)
    tyres = tyres.standing(placed(*place), [road])
    car = whole_car(place=place, velocity=(speed, 0, 0), tyres=tyres)
    way, took = speed**2 / (2 * GRIP * GRAVITY), speed / (GRIP * GRAVITY)
    options = SimulateOptions(
        objects={"car": ObjectPhysics()},
        colliders=[road],
        duration=1.3 * took,
        frame_rate=100.0,
        backend=backend,
    )
    result = simulate_bodies([car], options)
    own, times = result.objects["car"], result.times_s
    ways = own.positions[:, 0] - own.positions[0, 0]
    sliding = np.minimum(times, took)
    exact = speed * sliding - GRIP * GRAVITY * sliding**2 / 2
    speeds = np.linalg.norm(own.velocities, axis=1)
    stopped = float(times[np.argmax(speeds < 0.01 * speed)])
    curve = ReferenceCurve(times.tolist(), ways.tolist(), exact.tolist(), "time [s]", "way [m]")
    return [
        Check("tyres, braking: way", float(ways[-1]), way, 0.03 * way, "m", curve),
        Check("tyres, braking: time", stopped, took, 0.05 * took, "s"),
        Check("tyres, braking: it stays rigid", _deforming(own.modes), 0, 0),
    ]


def handover(backend: str) -> list[Check]:
    """Two blocks that fly, meet off centre and fly on: momenta stay through both handovers."""
    bodies = [_block("left", (-0.6, 0, 0), 2.0), _block("right", (0.6, 0.2, 0.1), -1.0)]
    before, energy = _momenta(bodies), sum(b.kinetic_energy for b in bodies)
    options = SimulateOptions(
        objects={b.name: ObjectPhysics() for b in bodies},
        duration=1.0,
        gravity=(0.0, 0.0, 0.0),
        backend=backend,
    )
    result = simulate_bodies(bodies, options)
    linear, angular = np.abs(_momenta(bodies) - before).max(axis=1)
    scale = bodies[0].rest.mass * 2.0
    met = sum(_deforming(o.modes) > 0 for o in result.objects.values())
    free = sum(o.modes[-1] == BodyMode.RIGID for o in result.objects.values())
    left = sum(b.kinetic_energy for b in bodies)
    return [
        Check("handover: momentum", float(linear) / scale, 0, 1e-6),
        Check("handover: angular momentum", float(angular) / scale, 0, 1e-6, "m"),
        Check("handover: kinetic energy gained", max(left / energy - 1, 0.0), 0, 1e-6),
        Check("handover: bodies that deformed", met, 2, 0),
        Check("handover: bodies that are rigid again", free, 2, 0),
    ]


def thin_post(backend: str) -> list[Check]:
    """A car at 11 m/s is stopped by a post of a third of a cell, at its middle and beside it."""
    speed, checks = 11.0, []
    for aside in (0.0, 0.3):
        post = Box(
            name="post",
            T_world_box=placed((CAR_SIZE[0] + POST) / 2 + 0.05, aside, 0),
            size=(POST, POST, 3.0),
        )
        options = SimulateOptions(
            objects={"car": ObjectPhysics()},
            colliders=[post],
            duration=0.35,
            gravity=(0.0, 0.0, 0.0),
            backend=backend,
        )
        result = simulate_bodies([whole_car(velocity=(speed, 0, 0))], options)
        own = result.objects["car"]
        # What turns about a post beside its middle goes on, but its part at the post does not.
        closing = own.velocities[-1, 0] - own.angular_velocities[-1, 2] * aside
        name = f"post of {POST} m, {aside} m aside"
        checks += [
            Check(f"{name}: speed against it", float(closing), -0.05 * speed, 0.15 * speed, "m/s"),
            Check(f"{name}: it was met", float(len(result.contacts)), 1, 0),
        ]
    return checks


def _block(name: str, place: Sequence[float], speed: float) -> DeformableBody:
    particles = box_particles((0.6, 0.6, 0.6), spacing=0.1, density=200.0)
    return DeformableBody(
        name,
        particles,
        [FixedCorotated(young=2e5, poisson=0.3, viscosity=300.0)],
        np.zeros(len(particles), dtype=np.int64),
        friction=0.5,
        cell=0.2,
        T_world_object=placed(*place),
        velocity=np.array([speed, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
    )


def _momenta(bodies: Sequence[DeformableBody]) -> Float:
    """[2, 3] momentum [N s], and angular momentum about the origin [N m s], of all together."""
    total = np.zeros((2, 3))
    for motion in (b.motion for b in bodies):
        orbital = np.cross(motion.centre, motion.momentum)
        total += [motion.momentum, orbital + motion.angular_momentum]
    return total


def _deforming(modes: NDArray[np.uint8]) -> int:
    return int((modes == BodyMode.DEFORMING).sum())


THEORY = {f.__name__: f for f in (tyre_braking, handover, thin_post)}
"""Cases by name; part of ``real2sim validate``."""
