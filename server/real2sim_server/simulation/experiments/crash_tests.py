"""Crash tests of the vehicle preset, compared with published figures and with theory.

Sources:

- Frontal barrier: test of the 2015 Chevrolet Malibu (NHTSA, as in joe-cormier/pycrash): 1651 kg,
  56.5 km/h, 10.1 in mean residual crush, restitution 0.013. Its load cells give 877 kN/m, from
  which follow 0.68 m of dynamic crush, a peak of 37 g and 68 ms to the peak.
- Restitution over impact speed: Cipriani et al. 2002, e = .47477 - .26139 L + .03382 L^2 - .11639
  L^3 with L = log10(v / (m/s)).
- Mutual stiffness of two cars: 405 +- 139 kN/m (Bonugli et al. 2017); 100 to 150 ms for a rear end.
- Roof: 127 mm at three times the weight (49 CFR 571.216a).
- Side against a pole of 254 mm at 32 km/h (49 CFR 571.214): intrusions of sedans are about 0.4 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float
from ...physics.body import box_particles
from ...physics.colliders import Box, Collider, Plane
from ...physics.materials import FixedCorotated
from ...physics.validation.check import Check, ReferenceCurve, placed
from ..body import BodyMode, DeformableBody
from ..impact import vehicle_body
from ..result import ObjectResult, SimulationResult
from ..rollout import SimulateOptions, simulate_bodies
from ..structure import GRAVITY, ObjectPhysics, preset_of, vehicle_structure
from ..tyres import Tyres

MALIBU_MASS = 1651.0
MALIBU_SIZE = (4.87, 1.85, 1.35)
"""Length and width of the car, height of its body above the wheels [m]."""
COLUMN = (0.4, 0.4)
"""Width and height of the simulated column of the car, with its fraction of the mass [m]. A block
that hits a wall squarely is uniform across its section."""
CAR_SIZE = (4.87, 1.85, 1.47)
"""Size of the whole car [m]."""
SPACING = 0.15
"""Particle spacing of the whole car [m]."""
FRAME_RATE = 500.0
FILTER = 5
"""Frames over which a pulse is averaged: 10 ms, about the resolution of a load-cell wall."""
BEGUN = 0.1
"""A pulse lasts while the deceleration is above this fraction of its peak."""
GAP = 0.02
"""Initial gap between the bodies [m]."""
LAYER, MIDDLE = 0.15, 0.3
"""Depth of the struck face, and half length of the middle, over which positions are averaged [m].
"""
POLE = 0.254
"""Diameter of the pole of FMVSS 214 [m]; here it is square."""


@dataclass(frozen=True)
class CrashPulse:
    """The crash pulse of one vehicle.

    Attributes:
        speed: closing speed [m/s].
        dynamic_crush, residual_crush: maximum and final crush of the struck side relative to the
            middle of the vehicle [m].
        peak: maximum deceleration [g], averaged over 10 ms.
        time_to_peak: time from contact to the peak [s].
        duration: time for which the deceleration exceeds a tenth of its peak [s].
        delta_v: velocity change along the initial closing direction [m/s].
        restitution: separation over approach speed.
        energy_peak: maximum total energy over the initial one; must not exceed 1.
    """

    speed: float
    dynamic_crush: float
    residual_crush: float
    peak: float
    time_to_peak: float
    duration: float
    delta_v: float
    restitution: float
    energy_peak: float


def column_car(*, speed: float = 0.0) -> DeformableBody:
    """The central column of the barrier test's car, along x, at ``speed`` [m/s]."""
    preset = preset_of("vehicle")
    fraction = float(np.prod(COLUMN) / np.prod(MALIBU_SIZE[1:]))
    block = box_particles((MALIBU_SIZE[0], *COLUMN), spacing=preset.spacing, density=1.0)
    materials, regions, particles = vehicle_structure(
        "car",
        block.with_mass(MALIBU_MASS * fraction),
        spacing=preset.spacing,
        section_height=MALIBU_SIZE[2],
    )
    return DeformableBody(
        "car",
        particles,
        materials,
        regions,
        friction=preset.friction,
        cell=2 * preset.spacing,
        T_world_object=np.eye(4),
        velocity=np.array([speed, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
    )


def whole_car(
    name: str = "car",
    *,
    mass: float = MALIBU_MASS,
    place: Sequence[float] = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    upside_down: bool = False,
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    spacing: float = SPACING,
    tyres: Tyres | None = None,
) -> DeformableBody:
    """A generic car with bonnet, cabin and boot, of the Malibu's size; ``place``: box centre."""
    body = vehicle_body(CAR_SIZE, mass=mass, friction=0.4, spacing=spacing)
    cos, sin = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:3, 3] = place
    if upside_down:
        pose[:3, 1:3] *= -1
    return DeformableBody(
        name,
        body.rest,
        body.materials,
        body.regions,
        friction=body.friction,
        cell=2 * spacing,
        T_world_object=pose,
        velocity=np.array(velocity, dtype=np.float64),
        angular_velocity=np.zeros(3),
        tyres=tyres,
    )


def barrier_test(speed: float, backend: str, *, duration: float | None = None) -> CrashPulse:
    """The car of the Malibu test against a rigid wall at ``speed`` [m/s]."""
    car = column_car(speed=speed)
    wall = Plane(
        name="wall", point=(MALIBU_SIZE[0] / 2 + GAP, 0, 0), normal=(-1, 0, 0), friction=0.3
    )
    duration = GAP / speed + 0.7 if duration is None else duration
    result = _crash([car], [wall], duration, backend)
    return crash_pulse(result, "car", speed, axis=0, side=1.0)


def rear_end(speed: float, backend: str) -> tuple[CrashPulse, CrashPulse]:
    """A car of 1000 kg hits the rear of a stationary one of 2000 kg; returns both pulses."""
    x = (CAR_SIZE[0] + GAP) / 2
    striker = whole_car("striker", mass=1000.0, place=(-x, 0, 0), velocity=(speed, 0, 0))
    struck = whole_car("struck", mass=2000.0, place=(x, 0, 0))
    result = _crash([striker, struck], [], 0.5, backend)
    return (
        crash_pulse(result, "striker", speed, axis=0, side=1.0),
        crash_pulse(result, "struck", speed, axis=0, side=-1.0),
    )


def side_crash(speed: float, backend: str) -> tuple[CrashPulse, CrashPulse]:
    """A car hits the side of a stationary one squarely; returns both pulses."""
    striker = whole_car("striker", place=(-(CAR_SIZE[0] + GAP) / 2, 0, 0), velocity=(speed, 0, 0))
    struck = whole_car("struck", place=((CAR_SIZE[1] + GAP) / 2, 0, 0), yaw=np.pi / 2)
    result = _crash([striker, struck], [], 0.4, backend)
    return (
        crash_pulse(result, "striker", speed, axis=0, side=1.0),
        crash_pulse(result, "struck", speed, axis=1, side=1.0, across=CAR_SIZE[1] / 4),
    )


def side_pole(speed: float, backend: str) -> CrashPulse:
    """A car slides sideways into a rigid pole at its middle."""
    pose = np.eye(4)
    pose[1, 3] = (CAR_SIZE[1] + POLE) / 2 + GAP
    pole = Box(name="pole", T_world_box=pose, size=(POLE, POLE, 3.0), friction=0.4)
    result = _crash([whole_car(velocity=(0, speed, 0))], [pole], 0.3, backend)
    return crash_pulse(result, "car", speed, axis=1, side=1.0, across=POLE / 2)


def roof_drop(speed: float, backend: str) -> CrashPulse:
    """A car falls on its roof at ``speed`` [m/s]."""
    ground = Plane(name="floor", friction=0.5)
    car = whole_car(place=(0, 0, CAR_SIZE[2] / 2 + GAP), upside_down=True, velocity=(0, 0, -speed))
    result = _crash([car], [ground], 0.3, backend, gravity=-GRAVITY)
    return crash_pulse(result, "car", speed, axis=2, side=1.0)


def crash_pulse(
    result: SimulationResult,
    name: str,
    speed: float,
    *,
    axis: int,
    side: float,
    across: float | None = None,
) -> CrashPulse:
    """Measure the pulse of a simulated crash.

    Args:
        result: simulation result.
        name: name of the vehicle.
        speed: closing speed [m/s].
        axis, side: struck face: axis 0 for the ends, 1 for the sides, 2 for the roof; side 1 or -1.
        across: half width of the struck area along the vehicle [m]; the whole face by default.
    """
    own, times = result.objects[name], result.times_s
    v = own.velocities - own.velocities[0]
    along = v[-1] / max(float(np.linalg.norm(v[-1])), 1e-9)
    step = float(times[1] - times[0])
    decelerations = np.gradient(v @ along, step) / GRAVITY
    pulse = np.convolve(decelerations, np.ones(FILTER) / FILTER, mode="same")
    above = np.flatnonzero(pulse > BEGUN * pulse.max())
    crush = _deflection(own, axis, side, across)
    velocities = {k: o.velocities @ along for k, o in result.objects.items()}
    others = [u for k, u in velocities.items() if k != name]
    apart = velocities[name] - (others[0] if others else 0.0)
    total = result.energies[:, :3].sum(axis=1)
    return CrashPulse(
        speed=speed,
        dynamic_crush=float(crush.max()),
        residual_crush=float(crush[-1]),
        peak=float(pulse.max()),
        time_to_peak=float(times[pulse.argmax()]) - GAP / speed,
        duration=step * len(above),
        delta_v=float(v[-1] @ along),
        restitution=float(-apart[-1] / apart[0]),
        energy_peak=float(total.max() / total[0]),
    )


def _deflection(own: ObjectResult, axis: int, side: float, across: float | None) -> Float:
    """[F] mean displacement of a face towards the middle of the vehicle [m]."""
    rest = own.rest.astype(np.float64)
    struck, kept = _face(rest, axis, side, across)
    if not len(own.shapes):
        return np.zeros(len(own.shape_index))
    moved = own.shapes[..., axis].astype(np.float64)
    by_shape = side * (moved[:, kept].mean(axis=1) - moved[:, struck].mean(axis=1))
    shown: Float = np.where(own.shape_index < 0, 0.0, by_shape[np.maximum(own.shape_index, 0)])
    return shown


def _face(
    rest: Float, axis: int, side: float, across: float | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Particles of the struck face, and of the undeformed middle."""
    inwards = side * rest[:, axis]
    struck = inwards > inwards.max() - LAYER
    below = rest[:, 2] < rest[:, 2].mean()
    kept = (np.abs(rest[:, 0]) < MIDDLE) & (np.abs(rest[:, 1]) < MIDDLE) & below
    if axis != 2:
        struck = struck & below
    if across is not None:
        struck = struck & (np.abs(rest[:, 0]) < across + SPACING / 2)
    return struck, kept


def _crash(
    bodies: Sequence[DeformableBody],
    colliders: Sequence[Collider],
    duration: float,
    backend: str,
    *,
    gravity: float = 0.0,
) -> SimulationResult:
    options = SimulateOptions(
        objects={b.name: ObjectPhysics() for b in bodies},
        colliders=colliders,
        road=(),
        duration=duration,
        frame_rate=FRAME_RATE,
        gravity=(0.0, 0.0, gravity),
        backend=backend,
    )
    return simulate_bodies(bodies, options)


# The vehicle preset against published crash figures.

MALIBU_SPEED = 56.5 / 3.6
MALIBU_CRUSH = 0.2565
MALIBU_DYNAMIC, MALIBU_PEAK, MALIBU_TIME = 0.68, 37.0, 0.068
"""Dynamic crush [m], peak [g] and time to the peak [s]."""
SPEEDS = (1.0, 2.24, 4.47, 8.94)
SPREAD = 0.08
MUTUAL_STIFFNESS = 405e3
ROOF_SPEED = 2.0
"""Speed of the roof drop [m/s]; pushes the roof in by about as much as the strength test."""
ROOF_DEPTH, ROOF_STRENGTH = 0.127, 3.0


def cipriani(speed: float) -> float:
    """Published mean restitution of cars at an impact speed [m/s]."""
    logarithm = np.log10(speed)
    return float(np.polyval([-0.11639, 0.03382, -0.26139, 0.47477], logarithm))


def malibu(backend: str) -> list[Check]:
    """The barrier test: pulse within 20 %, residual crush within 15 %."""
    return malibu_checks(barrier_test(MALIBU_SPEED, backend))


def malibu_checks(test: CrashPulse) -> list[Check]:
    """Checks of a test at the published speed against the published figures."""
    return [
        _within("Malibu dynamic crush", test.dynamic_crush, MALIBU_DYNAMIC, 0.2, "m"),
        _within("Malibu peak deceleration", test.peak, MALIBU_PEAK, 0.2, "g"),
        _within("Malibu time to the peak", test.time_to_peak, MALIBU_TIME, 0.2, "s"),
        _within("Malibu residual crush", test.residual_crush, MALIBU_CRUSH, 0.15, "m"),
        Check("Malibu restitution", test.restitution, 0.013, 0.15),
        Check("largest energy over the first", test.energy_peak, 1.0, 1e-3),
    ]


def restitution_by_speed(backend: str) -> list[Check]:
    """Restitution from walking pace to 32 km/h: as published, and decreasing with speed."""
    tests = [barrier_test(speed, backend, duration=0.5) for speed in SPEEDS]
    checks = [
        Check(f"restitution at {t.speed:.2f} m/s", t.restitution, cipriani(t.speed), SPREAD)
        for t in tests
    ]
    drops = [a.restitution - b.restitution for a, b in pairwise(tests)]
    return [*checks, Check("steps at which it falls", sum(d > 0 for d in drops), len(drops), 0)]


def collinear_pair(backend: str) -> list[Check]:
    """1000 kg hit the rear of 2000 kg at 10 m/s: duration, delta-v, and crush of both.

    The expected delta-v follows from the published restitution and its spread, not from the
    simulated one.
    """
    speed, light, heavy = 10.0, 1000.0, 2000.0
    striker, struck = rear_end(speed, backend)
    mass = light * heavy / (light + heavy)
    together = speed * float(np.sqrt(mass / MUTUAL_STIFFNESS))
    crush = striker.dynamic_crush + struck.dynamic_crush
    e = cipriani(speed)
    change, spread = mass * speed * (1 + e), mass * speed * SPREAD
    return [
        Check("rear end: duration", struck.duration, 0.12, 0.04, "s"),
        _within("rear end: crush of both", crush, together, 0.25, "m"),
        Check("rear end: delta-v striker", striker.delta_v, change / light, spread / light, "m/s"),
        Check("rear end: delta-v struck", struck.delta_v, change / heavy, spread / heavy, "m/s"),
        Check("rear end: energy over the first", striker.energy_peak, 1.0, 1e-3),
    ]


def pole(backend: str) -> list[Check]:
    """A car slides sideways into a pole at 32 km/h."""
    test = side_pole(8.9, backend)
    return [
        _within("side pole: intrusion", test.residual_crush, 0.4, 0.25, "m"),
        Check("side pole: energy over the first", test.energy_peak, 1.0, 1e-3),
    ]


def t_bone(backend: str) -> list[Check]:
    """A car hits the side of another at 12 m/s: both are dented and reach a common speed."""
    striker, struck = side_crash(12.0, backend)
    return [
        Check("side: door pushed in", struck.residual_crush, 0.2, 0.1, "m"),
        Check("side: delta-v of the struck", struck.delta_v, 6.5, 0.7, "m/s"),
        Check("side: energy over the first", striker.energy_peak, 1.0, 1e-3),
    ]


def roof(backend: str) -> list[Check]:
    """A car drops on its roof: intrusion, for a force of three times the weight at 127 mm."""
    test = roof_drop(ROOF_SPEED, backend)
    return [
        _within("roof: intrusion", test.dynamic_crush, ROOF_DEPTH, 0.25, "m"),
        _within("roof: force in weights", test.peak + 1, ROOF_STRENGTH, 0.25),
    ]


def _within(name: str, measured: float, expected: float, fraction: float, unit: str = "") -> Check:
    return Check(name, measured, expected, fraction * expected, unit)


PUBLISHED = {
    f.__name__: f for f in (malibu, restitution_by_speed, collinear_pair, pole, t_bone, roof)
}
"""Cases by name; ``real2sim validate --cases published`` runs them."""


# Bodies against theory: on tyres, changing between rigid and deforming, and at a post.

GRIP = 0.7
POST = 0.1
"""Edge of a post [m]: a third of a cell of the car."""


def tyre_braking(backend: str) -> list[Check]:
    """A car with locked wheels slides v^2 / (2 mu g) in v / (mu g) and pitches on its springs."""
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
    """Two blocks collide off centre and fly on: both mode changes conserve the momenta."""
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
    """A post a third of a cell wide stops a car at 11 m/s, centred and off centre."""
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
        # In an off-centre hit the vehicle rotates and moves on, but its part at the post stops.
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
    """[2, 3] total momentum [N s], and total angular momentum about the origin [N m s]."""
    total = np.zeros((2, 3))
    for motion in (b.motion for b in bodies):
        orbital = np.cross(motion.centre, motion.momentum)
        total += [motion.momentum, orbital + motion.angular_momentum]
    return total


def _deforming(modes: NDArray[np.uint8]) -> int:
    return int((modes == BodyMode.DEFORMING).sum())


THEORY = {f.__name__: f for f in (tyre_braking, handover, thin_post)}
"""Cases by name; part of ``real2sim validate``."""
