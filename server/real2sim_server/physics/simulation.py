"""Rollouts: objects of a scenario, colliders and gravity, from one instant on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..scene import Scene
from ..scene.rotation import Float, matrix_to_quaternion
from .cast import STANDS_WITHIN, cast
from .colliders import Collider
from .coupling.actor import DEFORMING, RESTING, RIGID, Actor
from .errors import PhysicsError
from .ledger import Ledger, energies
from .playback import PlacedObjects
from .presets import ObjectPhysics, preset_of
from .result import ObjectResult, SimulationResult
from .solver import Solver, SolverOptions

STEP = 0.005
"""Longest time between two looks at what is near whom [s]."""
RIGID_STEP = 0.0025
NEAR_CELLS = 3.0
"""Bodies loosen when something comes this near."""
CALM = 0.06
"""A body at unrest below this [m/s], or below CALM_SHARE of its speed, may become rigid again."""
CALM_SHARE = 0.03
CALM_TIME = 0.05
STILL_TIME = 0.08
REST_SPEED = 0.06
"""And when it hardly moves at all, it is laid to rest [m/s]."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulateOptions:
    """What to simulate.

    Attributes:
        preset: ``vehicle`` or ``paper``, see ``presets``.
        objects: what takes part, with what is known of it; at least one.
        colliders: that do not yield; those named in ``road`` carry tyres.
        road: names of colliders that are ground.
        start_us: scene time [us].
        duration: [s].
        frame_rate: frames kept per second.
        gravity: [3] [m/s^2].
        backend: of the solver.
        brake_after_hit: share of the wheels' grip that is braked once a vehicle was hit.
    """

    preset: str = "vehicle"
    objects: Mapping[str, ObjectPhysics] = field(default_factory=dict)
    colliders: Sequence[Collider] = ()
    road: Sequence[str] = ("ground",)
    start_us: int = 0
    duration: float = 2.0
    frame_rate: float = 30.0
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    backend: str = "auto"
    brake_after_hit: float = 1.0

    def __post_init__(self) -> None:
        preset_of(self.preset)
        if not self.objects:
            raise PhysicsError("no objects to simulate; name at least one")
        for name in ("duration", "frame_rate"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise PhysicsError(f"{name} must be positive, not {value!r}")
        if not 0 <= self.brake_after_hit <= 1:
            raise PhysicsError(f"brake_after_hit must be in [0, 1], not {self.brake_after_hit!r}")


def simulate(
    scene: Scene,
    state: PlacedObjects,
    options: SimulateOptions,
    *,
    on_progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> SimulationResult:
    """Let the objects move, collide, deform and come to rest.

    Args:
        scene: holds the Gaussians.
        state: the scenario's objects; a ``ScenarioState``.
        options: what to simulate.
        on_progress: called with (frames done, frames) after each frame.
        cancelled: asked before each step; when true, what was made until then is the result.

    Raises:
        PhysicsError: for what cannot be simulated, with the reason.
    """
    gravity = np.array(options.gravity, dtype=np.float64)
    if gravity.shape != (3,) or not np.isfinite(gravity).all():
        raise PhysicsError(f"gravity must be 3 finite numbers [m/s^2], not {options.gravity!r}")
    actors = cast(
        scene,
        state,
        options.objects,
        preset=preset_of(options.preset),
        start_us=options.start_us,
        colliders=[c for c in options.colliders if c.name in options.road],
        gravity=gravity,
    )
    return roll(actors, options, on_progress=on_progress, cancelled=cancelled)


def roll(
    actors: Sequence[Actor],
    options: SimulateOptions,
    *,
    on_progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> SimulationResult:
    """The same for bodies already cast. They are left as they are at the end."""
    stage = Stage(actors, options)
    frames = max(round(options.duration * options.frame_rate), 1)
    tape = Tape(stage)
    tape.keep(0.0)
    stopped = "done"
    for frame in range(1, frames + 1):
        end = frame / options.frame_rate
        while stage.time < end - 1e-9 and stopped == "done":
            if cancelled is not None and cancelled():
                stopped = "cancelled"
                break
            left = math.ceil((end - stage.time) / STEP - 1e-6)
            stage.advance((end - stage.time) / left)
        if stopped == "cancelled":
            break
        tape.keep(end)
        if on_progress is not None:
            on_progress(frame, frames)
    return tape.result(options, stopped)


class Stage:
    """Bodies and colliders in motion."""

    def __init__(self, actors: Sequence[Actor], options: SimulateOptions) -> None:
        self.actors = list(actors)
        self.colliders = list(options.colliders)
        self.options = options
        self.gravity = np.array(options.gravity, dtype=np.float64)
        self.ledger = Ledger()
        self.time = 0.0
        self.substeps = self.rollbacks = 0
        self._names = {a.name for a in actors}
        self._solver: Solver | None = None
        self._inside: list[str] = []
        for actor in self.actors:
            if self._stands(actor):
                actor.lay_down()

    @property
    def road(self) -> list[Collider]:
        """Colliders that carry tyres."""
        return [c for c in self.colliders if c.name in self.options.road]

    def _stands(self, actor: Actor) -> bool:
        """Whether a body that does not move is held by something, or by nothing drawn down."""
        m = actor.motion
        if np.any(m.velocity) or np.any(m.angular_velocity):
            return False
        return not np.any(self.gravity) or actor.gap_to_colliders(self.colliders)[0] < STANDS_WITHIN

    def advance(self, duration: float) -> None:
        """Go on by ``duration`` [s], at most STEP."""
        self._loosen(duration)
        deforming = [a for a in self.actors if a.mode == DEFORMING]
        if deforming:
            self._deform(deforming, duration)
        for actor in self.actors:
            if actor.mode == RIGID:
                self._move(actor, duration)
        if self._solver is None:
            self.colliders = [c.after(duration) for c in self.colliders]
        self.time += duration
        self._settle(deforming, duration)

    def _loosen(self, duration: float) -> None:
        """Rigid bodies that something comes near to become matter."""
        changed = True
        while changed:
            changed = False
            for actor in self.actors:
                if actor.mode != DEFORMING and self._is_near_anything(actor, duration):
                    actor.loosen()
                    self._solver = None
                    changed = True

    def _is_near_anything(self, actor: Actor, duration: float) -> bool:
        near = NEAR_CELLS * actor.cell
        for other in self.actors:
            if other is actor or (actor.mode == RESTING and other.mode == RESTING):
                continue
            if not self._approach(actor, other):
                continue
            closing = float(np.linalg.norm(actor.motion.velocity - other.motion.velocity))
            if actor.gap_to(other) < near + closing * duration:
                return True
        if actor.mode == RESTING:
            return False
        gap, approach = actor.gap_to_colliders(self._walls(actor))
        if approach > 0 and gap < near + approach * duration:
            return True
        if actor.tyres is None:
            return False
        # On its wheels a body is near the road all the time; it touches when springs are through.
        gap, approach = actor.gap_to_colliders(self.road)
        return gap < 0.4 * actor.cell + max(approach, 0) * duration

    def _walls(self, actor: Actor) -> list[Collider]:
        return (
            self.colliders
            if actor.tyres is None
            else [c for c in self.colliders if c.name not in self.options.road]
        )

    @staticmethod
    def _approach(a: Actor, b: Actor) -> bool:
        along = b.motion.centre - a.motion.centre
        return bool((a.motion.velocity - b.motion.velocity) @ along > 1e-3)

    def _move(self, actor: Actor, duration: float) -> None:
        """Rigid: fall, roll, slide."""
        steps = math.ceil(duration / RIGID_STEP - 1e-6)
        dt = duration / steps
        for _ in range(steps):
            m = actor.motion.falling(dt, self.gravity)
            if actor.tyres is not None:
                m, impulse, heat = actor.tyres.act(m, actor.T_world_object, self.road, dt)
                self.ledger.add(actor.name, "tyres", impulse, heat, self.time)
            actor.motion = m.moved(dt)
        m = actor.motion
        slow = np.linalg.norm(m.velocity) + np.linalg.norm(m.angular_velocity) < REST_SPEED / 2
        actor.calm_for = actor.calm_for + duration if slow and actor.tyres is not None else 0.0
        if actor.calm_for > 0.2:
            actor.lay_down()

    def _deform(self, deforming: list[Actor], duration: float) -> None:
        names = [a.name for a in deforming]
        if self._solver is None or self._inside != names:
            self._start_solver(deforming)
        assert self._solver is not None
        report = self._solver.step(duration)
        self.substeps += report.substeps
        self.rollbacks += report.rollbacks
        self.colliders = list(self._solver.colliders)
        self.ledger.add_contacts(self._solver.contacts, self.time, self._names)
        for actor, state in zip(deforming, self._solver.states(), strict=True):
            actor.take(state)
            actor.deforming_for += duration
            if actor.tyres is not None:
                self._roll_on(actor, duration)

    def _start_solver(self, deforming: list[Actor]) -> None:
        o = self.options
        self._solver = Solver(
            [a.body() for a in deforming],
            self.colliders,
            SolverOptions(dx=deforming[0].cell, gravity=o.gravity, backend=o.backend),
        )
        self._inside = [a.name for a in deforming]
        self.ledger.start_solver()

    def _roll_on(self, actor: Actor, duration: float) -> None:
        """The road acts on deforming vehicles' wheels too, as on a rigid body."""
        assert actor.tyres is not None
        moved, impulse, heat = actor.tyres.act(
            actor.motion, actor.T_world_object, self.road, duration
        )
        if not np.any(impulse):
            return
        self.ledger.add(actor.name, "tyres", impulse, heat, self.time)
        actor.kick(moved)
        self._solver = None

    def _settle(self, deforming: list[Actor], duration: float) -> None:
        """Matter that has calmed down becomes rigid, or is laid to rest."""
        for actor in deforming:
            self._note_hit(actor)
            speed = float(np.linalg.norm(actor.motion.velocity))
            turning = float(np.linalg.norm(actor.motion.angular_velocity))
            calm = actor.unrest() < max(CALM, CALM_SHARE * speed)
            actor.calm_for = actor.calm_for + duration if calm else 0.0
            # At the top of a bounce everything is slow for a moment, too.
            still = speed + turning < REST_SPEED
            actor.still_for = actor.still_for + duration if still else 0.0
            if actor.calm_for < CALM_TIME or actor.deforming_for < 2 * CALM_TIME:
                continue
            if actor.still_for > STILL_TIME:
                actor.stiffen(RESTING)
            elif self._is_free(actor):
                actor.stiffen(RIGID)
            else:
                continue
            self._solver = None

    def _is_free(self, actor: Actor) -> bool:
        for other in self.actors:
            if other is not actor and self._approach(actor, other):
                closing = float(np.linalg.norm(actor.motion.velocity - other.motion.velocity))
                if actor.gap_to(other) < NEAR_CELLS * actor.cell + closing * STEP:
                    return False
        gap, approach = actor.gap_to_colliders(self._walls(actor))
        if gap < NEAR_CELLS * actor.cell and (approach > 0 or actor.tyres is None):
            return False
        if actor.tyres is None:
            return True
        gap, approach = actor.gap_to_colliders(self.road)
        return gap > 0.4 * actor.cell + max(approach, 0) * STEP

    def _note_hit(self, actor: Actor) -> None:
        """Once a vehicle was hit, its wheels lock as far as options say."""
        if actor.hit or actor.tyres is None:
            return
        for (body, other), impulse in self.ledger.totals().items():
            hard = float(np.linalg.norm(impulse)) > 0.3 * actor.motion.mass
            if body == actor.name and other != "tyres" and other not in self.options.road and hard:
                actor.hit = True
                actor.tyres = actor.tyres.braked(self.options.brake_after_hit)
                return


class Tape:
    """Frames as they are made."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._times: list[float] = []
        self._energies: list[list[float]] = []
        self._impulses: list[dict[tuple[str, str], Float]] = []
        self._rows: dict[str, list[tuple[Float, Float, Float, Float, int, int]]] = {
            a.name: [] for a in stage.actors
        }
        self._shapes: dict[str, list[np.ndarray]] = {a.name: [] for a in stage.actors}
        self._start = 0.0

    def keep(self, time: float) -> None:
        """Keep the present state as the frame of ``time`` [s]."""
        s = self._stage
        kinetic, elastic, potential = energies(s.actors, s.gravity)
        total = kinetic + elastic + potential
        if not self._times:
            self._start = total
        gone = self._start + s.ledger.collider_work - s.ledger.heat - total
        self._energies.append(
            [kinetic, elastic, potential, s.ledger.heat, s.ledger.collider_work, gone]
        )
        self._times.append(time)
        self._impulses.append(s.ledger.totals())
        for actor in s.actors:
            pose, m = actor.T_world_object, actor.motion
            self._rows[actor.name].append(
                (
                    pose[:3, 3],
                    matrix_to_quaternion(pose[:3, :3]),
                    m.velocity,
                    m.angular_velocity,
                    actor.mode,
                    self._shape(actor),
                )
            )

    def _shape(self, actor: Actor) -> int:
        """Row of the shape that the actor has now; a new one only when it has changed."""
        rows = self._shapes[actor.name]
        moved = (actor.local_positions() - actor.rest.positions).astype(np.float16)
        if not rows and not moved.any():
            return -1
        if not rows or (actor.mode == DEFORMING or not np.array_equal(rows[-1], moved)):
            rows.append(moved)
        return len(rows) - 1

    def result(self, options: SimulateOptions, stopped: str) -> SimulationResult:
        """Everything kept so far."""
        s = self._stage
        objects = {a.name: self._object(a) for a in s.actors}
        contacts = s.ledger.records({a.name: a.motion.mass for a in s.actors})
        impulses = np.zeros((len(self._times), len(contacts), 3))
        for f, totals in enumerate(self._impulses):
            for c, contact in enumerate(contacts):
                impulses[f, c] = totals.get((contact.object_id, contact.other), np.zeros(3))
        figures = {
            "preset": options.preset,
            "gravity": list(options.gravity),
            "frame_rate": options.frame_rate,
            "cell": s.actors[0].cell,
            "particles": sum(len(a.rest) for a in s.actors),
            "substeps": s.substeps,
            "rollbacks": s.rollbacks,
        }
        return SimulationResult(
            objects,
            np.array(self._times),
            options.start_us,
            np.array(self._energies),
            contacts,
            impulses,
            stopped,
            figures,
        )

    def _object(self, actor: Actor) -> ObjectResult:
        places, turns, speeds, spins, modes, index = zip(*self._rows[actor.name], strict=True)
        n = len(actor.rest)
        return ObjectResult(
            object_id=actor.name,
            mass=actor.motion.mass,
            spacing=actor.spacing,
            rest=actor.rest.positions.astype(np.float32),
            positions=np.array(places),
            quaternions=np.array(turns),
            velocities=np.array(speeds),
            angular_velocities=np.array(spins),
            modes=np.array(modes, dtype=np.uint8),
            shape_index=np.array(index, dtype=np.int32),
            shapes=np.array(self._shapes[actor.name], dtype=np.float16).reshape(-1, n, 3),
        )
