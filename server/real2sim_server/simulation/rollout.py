"""Rollouts: objects of a scenario, colliders and gravity, from one instant on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..physics.colliders import Box, Collider
from ..physics.errors import PhysicsError
from ..scene import Scene
from .background import BACKGROUND, Cleared, background_colliders, described
from .body import DeformableBody
from .breakages import find_breakages
from .playback import PlacedObjects
from .presets import ObjectPhysics, preset_of
from .recorder import TrajectoryRecorder
from .result import SimulationResult
from .simulator import STEP, HybridSimulator
from .spawn import spawn_bodies, starts_of

PARTICLES_MIN = 100
BESIDE, FURTHEST = 10.0, 80.0
"""The background counts so far beyond what the fastest could reach, and no further than [m]."""

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
        times_s: instants of the frames after the start [s], rising, instead of both of these.
        gravity: [3] [m/s^2].
        backend: of the solver.
        brake_after_hit: fraction of the wheels' grip that is braked once a vehicle was hit.
        background: whether walls, poles, trees and what else stands in the scene's background are
            colliders too, see ``background``.
        max_particles: of all bodies together; where they would be more, all are filled more
            coarsely than the preset has it.
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
    """What of the background the objects may come to."""
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
    """The same for bodies already spawned. They are left as they are at the end."""
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
