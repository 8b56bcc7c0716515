"""Rollouts: simulate objects of a scenario from one instant and record frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..geometry import Float, apply_transform, matrix_to_quaternion
from ..physics.colliders import Box, Collider
from ..physics.errors import PhysicsError
from ..physics.solver import VISCOUS_STEP
from ..scene import Scene
from .background import BACKGROUND, Cleared, background_colliders, described
from .body import BodyMode, DeformableBody
from .breakage import Breakage, BreakageLog, Part
from .result import ObjectResult, PlacedObject, PlacedObjects, SimulationResult
from .simulator import STEP, HybridSimulator, energies
from .spawn import spawn_bodies, starts_of
from .structure import ObjectPhysics, preset_of

# Recording of frames as the simulation advances.


class TrajectoryRecorder:
    """Records trajectories, shapes, energies and contacts, frame by frame.

    Args:
        simulator: simulator to record; read-only.
    """

    def __init__(self, simulator: HybridSimulator) -> None:
        self._simulator = simulator
        self._times: list[float] = []
        self._energies: list[list[float]] = []
        self._impulses: list[dict[tuple[str, str], Float]] = []
        self._rows: dict[str, list[tuple[Float, Float, Float, Float, int, int, Float]]] = {
            b.name: [] for b in simulator.bodies
        }
        self._shapes: dict[str, list[np.ndarray]] = {b.name: [] for b in simulator.bodies}
        self._start = 0.0

    def record(self, time: float) -> None:
        """Record the current state as the frame of ``time`` [s]."""
        s = self._simulator
        kinetic, elastic, potential = energies(s.bodies, s.gravity)
        total = kinetic + elastic + potential
        if not self._times:
            self._start = total
        log = s.contact_log
        dissipated = self._start + log.collider_work - log.friction_work - total
        self._energies.append(
            [kinetic, elastic, potential, log.friction_work, log.collider_work, dissipated]
        )
        self._times.append(time)
        self._impulses.append(s.contact_log.totals())
        for body in s.bodies:
            pose, m = body.T_world_object, body.motion
            self._rows[body.name].append(
                (
                    pose[:3, 3],
                    matrix_to_quaternion(pose[:3, :3]),
                    m.velocity,
                    m.angular_velocity,
                    body.mode,
                    self._shape(body),
                    _wheel_lifts(body, pose, s.road),
                )
            )

    def _shape(self, body: DeformableBody) -> int:
        """Row of the body's current shape; adds a row only after a change."""
        rows = self._shapes[body.name]
        moved = (body.local_positions() - body.rest.positions).astype(np.float16)
        if not rows and not moved.any():
            return -1
        if not rows or (body.mode == BodyMode.DEFORMING or not np.array_equal(rows[-1], moved)):
            rows.append(moved)
        return len(rows) - 1

    def result(self, start_us: int, stopped: str, figures: Mapping[str, Any]) -> SimulationResult:
        """Everything recorded so far."""
        s = self._simulator
        objects = {b.name: self._object(b) for b in s.bodies}
        masses = {b.name: b.motion.mass for b in s.bodies}
        contacts = s.contact_log.records(masses, s.gravity)
        impulses = np.zeros((len(self._times), len(contacts), 3))
        for f, totals in enumerate(self._impulses):
            for c, contact in enumerate(contacts):
                impulses[f, c] = totals.get((contact.object_id, contact.other), np.zeros(3))
        return SimulationResult(
            objects,
            np.array(self._times),
            start_us,
            np.array(self._energies),
            contacts,
            impulses,
            stopped,
            figures,
        )

    def _object(self, body: DeformableBody) -> ObjectResult:
        positions, quaternions, velocities, spins, modes, index, lifts = zip(
            *self._rows[body.name], strict=True
        )
        n = len(body.rest)
        wheels = np.zeros((0, 3)) if body.tyres is None else body.tyres.patches
        return ObjectResult(
            object_id=body.name,
            mass=body.motion.mass,
            spacing=body.spacing,
            rest=body.rest.positions.astype(np.float32),
            positions=np.array(positions),
            quaternions=np.array(quaternions),
            velocities=np.array(velocities),
            angular_velocities=np.array(spins),
            modes=np.array(modes, dtype=np.uint8),
            shape_index=np.array(index, dtype=np.int32),
            shapes=np.array(self._shapes[body.name], dtype=np.float16).reshape(-1, n, 3),
            wheels=wheels.astype(np.float32),
            wheel_lifts=np.array(lifts, dtype=np.float32).reshape(len(positions), len(wheels)),
        )


def _wheel_lifts(body: DeformableBody, pose: Float, road: Sequence[Collider]) -> Float:
    return np.zeros(0) if body.tyres is None else body.tyres.lifts(pose, road)


# Broken parts of simulated vehicles, detected from the frames.

LEAVING_TIME = 0.04
"""Time after a part breaks at which its fragments separate [s]."""


def find_breakages(
    result: SimulationResult, subjects: Iterable[PlacedObject]
) -> tuple[Breakage, ...]:
    """All broken parts, ordered by object and time."""
    there = {s.object_id: s for s in subjects}
    found: list[Breakage] = []
    for object_id, own in result.objects.items():
        subject = there[object_id]
        log = BreakageLog(
            subject.category,
            subject.scaled_size,
            own.rest.astype(np.float64),
            spacing=own.spacing,
        )
        broken: list[tuple[Part, int]] = []
        last = -1
        for frame, row in enumerate(own.shape_index.tolist()):
            if row not in (-1, last):
                last = row
                new = log.follow(own.shapes[row].astype(np.float64))
                broken += [(part, frame) for part in new]
        found += [_breakage(result, own, log, part, frame) for part, frame in broken]
    return tuple(found)


def _breakage(
    result: SimulationResult, own: ObjectResult, log: BreakageLog, part: Part, frame: int
) -> Breakage:
    # Fragments leave with the velocity that remains after the local collapse.
    after = int(np.searchsorted(result.times_s, result.times_s[frame] + LEAVING_TIME))
    after = min(max(after, frame + 1), result.frames - 1)
    before = max(after - 1, 0)
    places = {f: _place(own, log, part, f) for f in (before, frame, after)}
    elapsed = float(result.times_s[after] - result.times_s[before])
    velocity = (places[after] - places[before]) / max(elapsed, 1e-9)
    outward = own.transform(frame)[:3, :3] @ np.array(part.outward)
    return Breakage(
        own.object_id,
        part.name,
        part.kind,
        float(result.times_s[frame]),
        _triple(places[frame]),
        _triple(velocity),
        _triple(outward),
        log.broken[part.name],
    )


def _place(own: ObjectResult, log: BreakageLog, part: Part, frame: int) -> Float:
    moved = own.displacements(frame)
    still = np.zeros_like(own.rest) if moved is None else moved
    local = log.place(part, still.astype(np.float64))
    placed: Float = apply_transform(own.transform(frame), local[None])[0]
    return placed


def _triple(vector: Float) -> tuple[float, float, float]:
    x, y, z = np.round(vector, 6).tolist()
    return x, y, z


PARTICLES_MIN = 100
MAX_FRAMES = 100_000
MAX_SUBSTEPS, CONTACT_TIME = 200_000, 10.0
"""Largest number of substeps of a body that deforms all the time, at most this long [s]; in longer
rollouts, bodies are rigid or asleep most of the time and need none."""
BESIDE, FURTHEST = 10.0, 80.0
"""Margin beyond the reach of the fastest object within which the background counts, and maximum
distance [m]."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulateOptions:
    """Options of a rollout.

    Attributes:
        preset: ``vehicle`` or ``paper``, see :mod:`.structure`.
        objects: simulated objects with their physical values; at least one.
        colliders: rigid colliders; those named in ``road`` support tyres.
        road: names of ground colliders.
        start_us: scene time of the start [us].
        duration: [s].
        frame_rate: recorded frames per second.
        times_s: increasing frame times after the start [s], instead of ``duration`` and
            ``frame_rate``.
        gravity: [3] [m/s^2].
        backend: solver backend.
        brake_after_hit: braked fraction of the wheels' grip after a vehicle is hit.
        background: whether obstacles of the scene's background (walls, poles, trees) are colliders,
            see :mod:`.background`.
        max_particles: maximum total number of particles; if exceeded, all objects are filled more
            coarsely than in the preset.
    """

    preset: str = "vehicle"
    objects: Mapping[str, ObjectPhysics] = field(default_factory=dict)
    colliders: Sequence[Collider] = ()
    road: Sequence[str] = ("ground",)
    start_us: int = 0
    duration: float = 2.0
    frame_rate: float = 30.0
    times_s: Sequence[float] | None = None
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    backend: str = "auto"
    brake_after_hit: float = 1.0
    background: bool = False
    max_particles: int = 400_000

    def __post_init__(self) -> None:
        preset_of(self.preset)
        if not self.objects:
            raise PhysicsError("no objects to simulate; name at least one")
        for name in ("duration", "frame_rate"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise PhysicsError(f"{name} must be positive, not {value!r}")
        frames = self.duration * self.frame_rate if self.times_s is None else len(self.times_s)
        if frames > MAX_FRAMES:
            raise PhysicsError(
                f"{self.duration:g} s at {self.frame_rate:g} frames per second are {frames:,.0f} "
                f"frames; at most {MAX_FRAMES:,} are recorded: simulate a shorter time, or record "
                "fewer frames per second"
            )
        if not 0 <= self.brake_after_hit <= 1:
            raise PhysicsError(f"brake_after_hit must be in [0, 1], not {self.brake_after_hit!r}")
        if self.max_particles < PARTICLES_MIN:
            raise PhysicsError(
                f"max_particles must be at least {PARTICLES_MIN}, not {self.max_particles!r}"
            )
        names = [c.name for c in self.colliders]
        twice = sorted({n for n in names if names.count(n) > 1} | (set(names) & set(self.objects)))
        if twice:
            raise PhysicsError(f"names of objects and colliders must be unique; {twice} are not")


def simulate(
    scene: Scene,
    state: PlacedObjects,
    options: SimulateOptions,
    *,
    on_progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> SimulationResult:
    """Simulate the motion, collisions and deformation of objects until the end of the rollout.

    Args:
        scene: scene with the Gaussians.
        state: the scenario's objects; a ``ScenarioState``.
        options: options of the rollout.
        on_progress: called with (frames done, frames) after each frame.
        cancelled: polled before each step; if true, the simulation ends with the frames so far.

    Raises:
        PhysicsError: if the options cannot be simulated, with the reason.
    """
    gravity = np.array(options.gravity, dtype=np.float64)
    if gravity.shape != (3,) or not np.isfinite(gravity).all():
        raise PhysicsError(f"gravity must be 3 finite numbers [m/s^2], not {options.gravity!r}")
    solid = solid_background(scene, state, options) if options.background else []
    options = replace(options, colliders=[*options.colliders, *solid])
    bodies = spawn_bodies(
        scene,
        state,
        options.objects,
        preset=preset_of(options.preset),
        start_us=options.start_us,
        colliders=options.colliders,
        road=options.road,
        gravity=gravity,
        max_particles=options.max_particles,
    )
    result = simulate_bodies(bodies, options, on_progress=on_progress, cancelled=cancelled)
    if options.preset == "vehicle":
        result = replace(result, breakages=find_breakages(result, state.visible))
    if options.background:
        result = replace(result, figures={**result.figures, BACKGROUND: described(solid)})
    return result


def solid_background(scene: Scene, state: PlacedObjects, options: SimulateOptions) -> list[Box]:
    """The background within the objects' reach, as colliders."""
    starts = starts_of(state, options.objects, options.start_us)
    cleared = [Cleared(s.T_world_object, np.array(s.size)) for s in starts]
    fastest = max(float(np.linalg.norm(s.velocity)) for s in starts)
    way = min(fastest * options.duration + BESIDE, FURTHEST)
    return background_colliders(scene, cleared, within=way)


def simulate_bodies(
    bodies: Sequence[DeformableBody],
    options: SimulateOptions,
    *,
    on_progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> SimulationResult:
    """Like :func:`simulate`, for spawned bodies, which keep their final state."""
    simulator = HybridSimulator(
        bodies,
        options.colliders,
        road=options.road,
        gravity=options.gravity,
        backend=options.backend,
        brake_after_hit=options.brake_after_hit,
        cfl=preset_of(options.preset).cfl,
    )
    ends = options.times_s
    if ends is None:
        frames = max(round(options.duration * options.frame_rate), 1)
        ends = [frame / options.frame_rate for frame in range(1, frames + 1)]
    for body in bodies:
        _check_substeps(body, preset_of(options.preset).cfl, min(ends[-1], CONTACT_TIME))
    recorder = TrajectoryRecorder(simulator)
    recorder.record(0.0)
    stopped = "done"
    for frame, end in enumerate(ends, 1):
        while simulator.time < end - 1e-9 and stopped == "done":
            if cancelled is not None and cancelled():
                stopped = "cancelled"
                break
            left = math.ceil((end - simulator.time) / STEP - 1e-6)
            simulator.advance((end - simulator.time) / left)
        if stopped == "cancelled":
            break
        recorder.record(end)
        if on_progress is not None:
            on_progress(frame, len(ends))
    return recorder.result(options.start_us, stopped, _figures(options, simulator))


def _check_substeps(body: DeformableBody, cfl: float, seconds: float) -> None:
    """Raise PhysicsError if a body would need more than ``MAX_SUBSTEPS`` to deform for so long."""
    rest, cell = body.rest, body.cell
    modulus, viscosity = (
        np.array([getattr(m, name) for m in body.materials])[body.regions]
        for name in ("wave_modulus", "viscosity")
    )
    densities = rest.masses / rest.volumes
    stiffest = int(np.argmax(modulus / densities))
    wave = math.sqrt(modulus[stiffest] / densities[stiffest])
    moving = float(np.linalg.norm(body.motion.velocity))
    damping = float((viscosity / densities).max())
    step = cfl * cell / (wave + moving)
    if damping > 0:
        step = min(step, VISCOUS_STEP * cell**2 / damping)
    if seconds <= MAX_SUBSTEPS * step:
        return
    young = body.materials[body.regions[stiffest]].young
    allowed = max(cfl * cell * MAX_SUBSTEPS / seconds - moving, 0.0)
    softer = f"a Young's modulus of at most {young * (allowed / wave) ** 2:.2g} Pa, "
    raise PhysicsError(
        f"object {body.name!r}, with a Young's modulus of {young:.3g} Pa, a density of "
        f"{densities[stiffest]:.3g} kg/m^3 and cells of {cell:.3g} m, needs "
        f"{seconds / step:,.0f} substeps of {step * 1e6:.2g} us for {seconds:g} s; at most "
        f"{MAX_SUBSTEPS:,} are allowed: take {softer * (0 < allowed < wave)}a larger density, "
        f"larger cells (a smaller grid), or at most {MAX_SUBSTEPS * step:.2g} s"
    )


def _figures(options: SimulateOptions, simulator: HybridSimulator) -> dict[str, Any]:
    return {
        "preset": options.preset,
        "gravity": list(options.gravity),
        "frame_rate": options.frame_rate,
        "cell": simulator.bodies[0].cell,
        "particles": sum(len(b.rest) for b in simulator.bodies),
        "substeps": simulator.substeps,
        "rollbacks": simulator.rollbacks,
        "restitution": {
            b.name: b.rebound.figures() | {"bounces": simulator.bounces.figures(b.name)}
            for b in simulator.bodies
            if b.rebound is not None
        },
    }
