"""A single impact of two bodies with permanent deformation.

The closed loop uses rigid bodies; this module computes how an impact changes their shapes. It
ignores road, gravity and wheels: during the tenth of a second of a crash, their effect on
velocities is about a twentieth of the crash's effect.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float, apply_transform
from ..physics.body import Particles, box_particles
from ..physics.colliders import Box, Collider
from ..physics.materials import Material
from ..physics.solver import Solver, SolverOptions
from ..scene import GaussianCloud
from .body import DeformableBody, DeformedShape
from .particles import fill_object
from .structure import VEHICLES, preset_of

PARTICLES = 1000
"""Approximate number of particles per body. Twice as many take twice the time and change residual
crush by up to a fifth, and the impulse by less. A step of a closed loop waits for the result."""
MIN_SPACING = 0.1
"""Minimum particle spacing [m]."""
HOOD, UNDER, CABIN = 0.95, 0.2, (0.22, 0.84)
"""Plain vehicle: height of its hood and of its underside [m]; start and end of its cabin, as
fractions of the length from the rear."""
CFL = 0.6
"""Fraction of a cell that waves may cross in a substep. Crashes are strongly damped, so shorter
substeps are not more stable."""
SAMPLE_DT = 0.005
FRAME_SAMPLES = 2
MAX_CRASH_TIME = 0.25
"""Maximum simulated duration of a crash [s]."""
SETTLING_TIME = 0.015
"""Time to simulate after separation, in which shapes settle [s]."""
TOUCHED, ENDED = 0.01, 0.002
"""Velocity changes at which a crash begins and continues, as fractions of the closing speed."""


@dataclass(frozen=True, eq=False)
class CrashBody:
    """A body before or after an impact, in its own frame.

    Attributes:
        rest: undeformed particles, object frame.
        materials, regions: see :class:`~..physics.body.Body`.
        friction: friction coefficient of its surface.
        spacing: particle spacing [m].
        shape: shape after earlier impacts, or None.
    """

    rest: Particles
    materials: tuple[Material, ...]
    regions: NDArray[np.int64]
    friction: float
    spacing: float
    shape: DeformedShape | None = None

    @property
    def positions(self) -> Float:
        """[N, 3] current particle positions, object frame [m]."""
        return self.rest.positions if self.shape is None else self.shape.positions


@dataclass(frozen=True, eq=False)
class ImpactBody:
    """A body before an impact.

    Attributes:
        body: the body.
        T_world_object: [4, 4].
        velocity: [3] velocity of its centre of mass [m/s].
        yaw_rate: about the world's z axis [rad/s].
    """

    body: CrashBody
    T_world_object: Float
    velocity: Float
    yaw_rate: float = 0.0

    @property
    def positions(self) -> Float:
        """[N, 3] particle positions in the world [m]."""
        return apply_transform(self.T_world_object, self.body.positions)


@dataclass(frozen=True, eq=False)
class ImpactResult:
    """The effect of an impact on one body.

    Attributes:
        body: the body after the impact.
        displacements: [F, N, 3] float32 particle displacements from rest, object frame [m]; every
            ``FRAME_S`` from first contact; the last one is permanent.
        delta_v: [3] velocity change of its centre of mass [m/s].
        depth: maximum particle displacement by this impact [m].
    """

    body: CrashBody
    displacements: NDArray[np.float32]
    delta_v: Float
    depth: float


FRAME_S = SAMPLE_DT * FRAME_SAMPLES


def object_body(
    cloud: GaussianCloud, size: Sequence[float], *, category: str, mass: float, friction: float
) -> CrashBody:
    """An object of a scene, filled with particles.

    Args:
        cloud: its Gaussians, object frame with its origin at the box centre.
        size: (length, width, height) of the box [m].
        category: category of the object; vehicles get crumple zones.
        mass: [kg].
        friction: friction coefficient of its surface.

    Raises:
        ParticleError: from ``fill_object``.
    """
    spacing = _spacing(size)
    filling = fill_object(cloud, size, spacing=spacing, mass=mass, category=category)
    above = -np.inf
    if category in VEHICLES:
        above = -size[2] / 2 + preset_of("vehicle").clearance
    return _body(filling.lattice(above=above), category, spacing, friction)


def vehicle_body(
    size: Sequence[float], *, mass: float, friction: float, spacing: float | None = None
) -> CrashBody:
    """A generic car with bonnet, cabin and boot, from its box alone.

    The origin of its frame is the box centre. ``spacing``: particle spacing [m].
    """
    spacing = _spacing(size) if spacing is None else spacing
    block = box_particles(tuple(size), spacing=spacing, density=1.0)
    fraction = block.positions[:, 0] / size[0] + 0.5
    height = block.positions[:, 2] + size[2] / 2
    in_cabin = (fraction > CABIN[0]) & (fraction < CABIN[1])
    kept = (height > UNDER) & ((height < HOOD) | in_cabin)
    cut = Particles(
        block.positions[kept], block.volumes[kept], block.masses[kept], block.source[kept]
    )
    return _body(cut.with_mass(mass), "car", spacing, friction)


def _spacing(size: Sequence[float]) -> float:
    return max(MIN_SPACING, float(np.cbrt(np.prod(size) / PARTICLES)))


def _body(rest: Particles, category: str, spacing: float, friction: float) -> CrashBody:
    materials, regions, rest = preset_of("vehicle").build(category, rest, spacing)
    return CrashBody(rest, tuple(materials), regions, friction, spacing)


def simulate_impact(
    first: ImpactBody, second: ImpactBody | Box
) -> tuple[ImpactResult, ImpactResult | None] | None:
    """Simulate a body's impact on another body or a rigid obstacle.

    Moves both along their velocities to just before contact, then solves the impact. Conserves
    total momentum.

    Args:
        first, second: bodies near the contact, with their velocities before it.

    Returns:
        Results of both; None for a collider; None instead of both if they miss.
    """
    return ImpactSimulation(first, second).results()


class ImpactSimulation:
    """An impact, solved frame by frame on request."""

    def __init__(self, first: ImpactBody, second: ImpactBody | Box) -> None:
        """See :func:`simulate_impact`."""
        self._before = [first, second] if isinstance(second, ImpactBody) else [first]
        self._frames: list[list[Float]] = [[] for _ in self._before]
        self._mean_velocity = np.zeros(3)
        closing = first.velocity
        if isinstance(second, ImpactBody):
            self._mean_velocity = _mean_velocity(self._before)
            closing = closing - second.velocity
        along = closing / float(np.linalg.norm(closing))
        cell = 2 * max(b.body.spacing for b in self._before)
        free_path = _free_path(first, second, along, cell)
        self._steps: Iterator[None] | None = None
        self._bodies: list[DeformableBody] = []
        if free_path is None:
            return
        self._bodies = [
            _spawn_body(f"body {k}", b, self._mean_velocity, cell)
            for k, b in enumerate(self._before)
        ]
        self._bodies[0].translate(free_path * along)
        colliders = [] if isinstance(second, ImpactBody) else [second]
        self._steps = _collide(self._bodies, colliders, along, self._frames)

    def displacements(self, role: int, count: int) -> list[Float]:
        """The first ``count`` frames of a body, see :class:`ImpactResult`.

        Fewer if the impact ends earlier; none if the bodies miss.

        Raises:
            PhysicsError: the solver failed; earlier frames remain available.
        """
        while self._steps is not None and len(self._frames[role]) < count:
            self._go_on()
        return self._frames[role][:count]

    def results(self) -> tuple[ImpactResult, ImpactResult | None] | None:
        """The final results of both bodies; see :func:`simulate_impact`. Raises as above."""
        while self._steps is not None:
            self._go_on()
        if not self._bodies:
            return None
        results = [
            _impact_result(before, body, history, self._mean_velocity)
            for before, body, history in zip(self._before, self._bodies, self._frames, strict=True)
        ]
        return results[0], results[1] if len(results) == 2 else None

    def _go_on(self) -> None:
        """Simulate one more frame."""
        steps, self._steps = self._steps, None
        assert steps is not None
        with contextlib.suppress(StopIteration):
            next(steps)
            self._steps = steps


def _mean_velocity(impact_bodies: Sequence[ImpactBody]) -> Float:
    masses = np.array([b.body.rest.mass for b in impact_bodies])
    velocities = np.stack([b.velocity for b in impact_bodies])
    mean: Float = masses @ velocities / masses.sum()
    return mean


def _free_path(
    first: ImpactBody, second: ImpactBody | Box, along: Float, cell: float
) -> float | None:
    """Distance [m] that ``first`` can move until contact; None if it misses."""
    side = np.cross([0.0, 0.0, 1.0], along)
    across = np.stack([side / np.linalg.norm(side), np.cross(along, side)])
    own = first.positions
    if isinstance(second, ImpactBody):
        other, apart = second.positions, (first.body.spacing + second.body.spacing) / 2
    else:
        other, apart = _surface(second, own, cell), first.body.spacing / 2
    if not len(other):
        return None
    front = _outermost(own @ across.T, own @ along, cell, np.maximum)
    back = _outermost(other @ across.T, other @ along, cell, np.minimum)
    gaps = [back[key] - front[key] for key in sorted(front.keys() & back.keys())]
    return min(gaps) - apart - 0.1 * cell if gaps else None


def _outermost(places: Float, depths: Float, cell: float, choose: Any) -> dict[Any, float]:
    """The outermost point in each square of a grid across the direction of motion."""
    found: dict[tuple[int, int], float] = {}
    for (i, j), depth in zip(np.floor(places / cell).astype(int).tolist(), depths, strict=True):
        found[i, j] = float(choose(found.get((i, j), depth), depth))
    return found


def _surface(box: Box, like: Float, cell: float) -> Float:
    """[N, 3] points of a box, world frame, in the height range of ``like``."""
    pose, size = np.asarray(box.T_world_box), np.asarray(box.size)
    steps = [np.arange(-s / 2, s / 2 + cell / 4, cell / 2) for s in size]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = apply_transform(pose, grid)
    near: Float = points[points[:, 2] < like[:, 2].max() + cell]
    return near


def _spawn_body(
    name: str, impact_body: ImpactBody, mean_velocity: Float, cell: float
) -> DeformableBody:
    crash_body = impact_body.body
    return DeformableBody(
        name,
        crash_body.rest,
        crash_body.materials,
        crash_body.regions,
        friction=crash_body.friction,
        cell=cell,
        T_world_object=impact_body.T_world_object,
        velocity=impact_body.velocity - mean_velocity,
        angular_velocity=np.array([0.0, 0.0, impact_body.yaw_rate]),
        shape=crash_body.shape,
    )


def _collide(
    bodies: Sequence[DeformableBody],
    colliders: Sequence[Collider],
    along: Float,
    histories: list[list[Float]],
) -> Iterator[None]:
    """Step until the bodies have separated; append each frame's particle displacements."""
    options = SolverOptions(dx=bodies[0].cell, gravity=(0.0, 0.0, 0.0), backend="cpu", cfl=CFL)
    solver = Solver([b.solver_body() for b in bodies], colliders, options)
    first = last = _closing(solver, along)
    samples, settling_time = 0, 0.0
    for _ in range(round(MAX_CRASH_TIME / SAMPLE_DT)):
        solver.step(SAMPLE_DT)
        speed = _closing(solver, along)
        if first - speed > TOUCHED * first:
            samples += 1
            if samples % FRAME_SAMPLES == 0:
                _record_displacements(bodies, solver, histories)
                yield
        if samples and (speed <= 0 or last - speed < ENDED * first):
            settling_time += SAMPLE_DT
        if settling_time > SETTLING_TIME:
            break
        last = speed
    _record_displacements(bodies, solver, histories)


def _closing(solver: Solver, along: Float) -> float:
    m = solver.measure
    velocities = m.momentum / np.asarray(m.mass)[:, None] @ along
    return float(velocities[0] - (velocities[1] if len(velocities) == 2 else 0.0))


def _record_displacements(
    bodies: Sequence[DeformableBody], solver: Solver, histories: list[list[Float]]
) -> None:
    for body, state, history in zip(bodies, solver.states(), histories, strict=True):
        body.update_from_solver(state)
        moved = body.local_positions() - body.rest.positions
        # The pose is that of the undeformed majority of the body.
        history.append(moved - np.median(moved, axis=0))


def _impact_result(
    before: ImpactBody, body: DeformableBody, history: Sequence[Float], mean_velocity: Float
) -> ImpactResult:
    delta_v = body.motion.velocity + mean_velocity - before.velocity
    body.rigidify()
    rest = before.body.rest
    shape = replace(body.shape, positions=rest.positions + history[-1])
    moved = np.linalg.norm(shape.positions - before.body.positions, axis=1)
    frames = np.stack(history).astype(np.float32)
    return ImpactResult(replace(before.body, shape=shape), frames, delta_v, float(moved.max()))
