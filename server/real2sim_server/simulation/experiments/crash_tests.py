"""Crash tests of the vehicle preset, and what is read off them: pulse, crush, restitution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...physics.body import box_particles
from ...physics.colliders import Box, Collider, Plane
from ..body import DeformableBody
from ..impact import vehicle_body
from ..presets import ObjectPhysics, preset_of
from ..result import ObjectResult, SimulationResult
from ..rollout import SimulateOptions, simulate_bodies
from ..structure import GRAVITY, vehicle_structure
from ..tyres import Tyres

MALIBU_MASS = 1651.0
MALIBU_SIZE = (4.87, 1.85, 1.35)
"""Length and width of the car, height of its body above the wheels [m]."""
COLUMN = (0.4, 0.4)
"""Width and height of the part of it that is simulated against a wall, with its fraction of the
mass [m]. Nothing differs across a block that meets a wall squarely."""
CAR_SIZE = (4.87, 1.85, 1.47)
"""Of the whole car [m]."""
SPACING = 0.15
"""Of the whole car's particles [m]."""
FRAME_RATE = 500.0
FILTER = 5
"""Frames over which a pulse is averaged: 10 ms, about what a load-cell wall resolves."""
BEGUN = 0.1
"""A pulse lasts while the deceleration is above this fraction of its peak."""
GAP = 0.02
"""Between the bodies at the start [m]."""
LAYER, MIDDLE = 0.15, 0.3
"""Depth of the struck face and half length of the middle that are averaged [m]."""
POLE = 0.254
"""Diameter of the pole of FMVSS 214 [m]; here it is square."""


@dataclass(frozen=True)
class CrashPulse:
    """What one vehicle did in a crash.

    Attributes:
        speed: closing speed [m/s].
        dynamic_crush, residual_crush: of the struck side against the vehicle's middle, at most and
            in the end [m].
        peak: largest deceleration [g], averaged over 10 ms.
        time_to_peak: from contact [s].
        duration: for which the deceleration was above a tenth of its peak [s].
        delta_v: change of velocity along the first closing direction [m/s].
        restitution: separation over approach speed.
        energy_peak: largest total energy over the first, which no crash may raise.
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
    """A column out of the middle of the barrier test's car, along x, at ``speed`` [m/s]."""
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
    """A plain car with hood, cabin and boot, of the Malibu's size; ``place``: of its box."""
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
    """A car of 1000 kg into the rear of a standing one of 2000 kg: the pulses of both."""
    x = (CAR_SIZE[0] + GAP) / 2
    striker = whole_car("striker", mass=1000.0, place=(-x, 0, 0), velocity=(speed, 0, 0))
    struck = whole_car("struck", mass=2000.0, place=(x, 0, 0))
    result = _crash([striker, struck], [], 0.5, backend)
    return (
        crash_pulse(result, "striker", speed, axis=0, side=1.0),
        crash_pulse(result, "struck", speed, axis=0, side=-1.0),
    )


def side_crash(speed: float, backend: str) -> tuple[CrashPulse, CrashPulse]:
    """A car into the side of another one that stands, squarely: the pulses of both."""
    striker = whole_car("striker", place=(-(CAR_SIZE[0] + GAP) / 2, 0, 0), velocity=(speed, 0, 0))
    struck = whole_car("struck", place=((CAR_SIZE[1] + GAP) / 2, 0, 0), yaw=np.pi / 2)
    result = _crash([striker, struck], [], 0.4, backend)
    return (
        crash_pulse(result, "striker", speed, axis=0, side=1.0),
        crash_pulse(result, "struck", speed, axis=1, side=1.0, across=CAR_SIZE[1] / 4),
    )


def side_pole(speed: float, backend: str) -> CrashPulse:
    """A car that slides sideways into a rigid pole at its middle."""
    pose = np.eye(4)
    pose[1, 3] = (CAR_SIZE[1] + POLE) / 2 + GAP
    pole = Box(name="pole", T_world_box=pose, size=(POLE, POLE, 3.0), friction=0.4)
    result = _crash([whole_car(velocity=(0, speed, 0))], [pole], 0.3, backend)
    return crash_pulse(result, "car", speed, axis=1, side=1.0, across=POLE / 2)


def roof_drop(speed: float, backend: str) -> CrashPulse:
    """A car that falls on its roof at ``speed`` [m/s]."""
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
    """What is read off a simulated crash.

    Args:
        result: frames of all bodies.
        name: of the vehicle.
        speed: closing speed [m/s].
        axis, side: which face of it was struck: 0 its ends, 1 its sides, 2 its roof; 1 or -1.
        across: half width of the struck place along the vehicle [m]; the whole face by default.
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
    """[F] how far a face came towards the middle of the vehicle, on average [m]."""
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
    """Particles of the struck face, and of the middle that keeps its shape."""
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
