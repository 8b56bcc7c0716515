"""A scene object as a body: rigid when free, deforming in contact, asleep at rest.

The body owns its state, its timers and the transitions between modes. The simulator triggers the
transitions (activate, rigidify, put to sleep) and reads the state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float, apply_transform, box_penetration
from ..physics.body import Body, Particles
from ..physics.colliders import Collider, Solid
from ..physics.materials import Material
from ..physics.solver import BodyState
from .result import Rebound
from .rigid import (
    RigidMotion,
    added_inertia,
    best_rotation,
    closest,
    cross_matrix,
    inertia_about,
    packed,
    solid_gaps,
)
from .tyres import TyreReaction, Tyres, advance_on_wheels

NO_TYRES = Tyres(np.zeros((0, 3)), np.zeros(0), rest=np.zeros(0))

SURFACE_POINTS = 600
NEIGHBOUR_SPACINGS = 1.3
"""Maximum distance of neighbours in a lattice of particles [spacings]."""
NEAR_MAX = 4.0
"""Maximum distance of solids in gap queries [m]."""
CORNER = 0.87
"""Distance from a particle to the corners of its cube [spacings]."""
RIGID_STEP = 0.0025
"""Maximum time step of rigid motion [s]."""
SETTLED_SPEED = 0.06
"""A body has settled when its residual speed is below this, or below SETTLED_FRACTION of its speed
[m/s]."""
SETTLED_FRACTION = 0.03
JOLT = 15.0
"""Maximum acceleration of a settled body: 1.5 times free fall [m/s^2]."""
SETTLE_TIME = 0.05
"""Time after settling before the body may become rigid [s]."""
SLEEP_SPEED = 0.06
"""Maximum speed and angular speed for sleep, [m/s] and [rad/s] combined."""
SLEEP_TIME = 0.08
"""Time at that speed before sleep [s]; a body is also slow for a moment at the top of a bounce."""
WHEELS_SLEEP_TIME = 0.2
"""The same for a rigid body on its wheels, at half that speed [s]."""


class BodyMode(IntEnum):
    """The motion mode of a body."""

    SLEEPING = 0
    RIGID = 1
    DEFORMING = 2


@dataclass(frozen=True, eq=False)
class DeformedShape:
    """Permanent deformation in the object's frame.

    Attributes:
        positions: [N, 3] particles [m].
        F_elastic, F_total: [N, 3, 3].
        history: [N] plastic memory.
    """

    positions: Float
    F_elastic: Float
    F_total: Float
    history: Float


class DeformableBody:
    """A body of a simulation in its current mode of motion.

    Args:
        name: object id.
        particles: particles at rest, object frame.
        materials, regions: see :class:`~..physics.body.Body`.
        friction: friction coefficient of its surface.
        cell: cell size of the solver grid [m].
        T_world_object: [4, 4] initial pose.
        velocity: [3] initial velocity of the centre of mass [m/s].
        angular_velocity: [3] world axes [rad/s].
        tyres: tyres of a body on wheels, or None.
        shape: shape after earlier deformation, or None.

    Attributes:
        acceleration: [3] acceleration of the centre of mass in the last deforming step [m/s^2];
            zero in other modes.
    """

    def __init__(
        self,
        name: str,
        particles: Particles,
        materials: Sequence[Material],
        regions: NDArray[np.int64],
        *,
        friction: float,
        cell: float,
        T_world_object: Float,
        velocity: Float,
        angular_velocity: Float,
        tyres: Tyres | None = None,
        shape: DeformedShape | None = None,
    ) -> None:
        self.name = name
        self.rest = particles
        self.materials = tuple(materials)
        self.regions = regions
        self.friction = friction
        self.cell = cell
        self.tyres = tyres
        self.shape = _undeformed(particles) if shape is None else shape
        self.spacing = float(np.cbrt(np.median(particles.volumes)))
        pose = np.array(T_world_object, dtype=np.float64)
        if shape is None:
            centre = apply_transform(pose, particles.centre_of_mass[None])[0]
        else:
            centre = particles.masses @ apply_transform(pose, shape.positions) / particles.mass
        self.motion = RigidMotion(
            rotation=pose[:3, :3],
            centre=centre,
            velocity=np.array(velocity, dtype=np.float64),
            angular_velocity=np.array(angular_velocity, dtype=np.float64),
            mass=particles.mass,
            inertia=inertia_about(
                particles.centre_of_mass, particles.positions, particles.masses, particles.volumes
            ),
        )
        self.mode = BodyMode.RIGID
        self.hit = False
        self.supports: frozenset[str] = frozenset()
        self.state: BodyState | None = None
        self.rebound: Rebound | None = None
        self._added_inertia = added_inertia(particles.masses, particles.volumes, cell=cell)
        self._carried = np.zeros(3)
        self.acceleration: Float = np.zeros(3)
        self._velocity_before = self.motion.velocity
        self._hull = _hull(particles.positions)
        self._shell = _shell(particles.positions, self.spacing)
        self._centre_of: DeformedShape | None = None
        self._outlines_of: DeformedShape | None = None
        self._bounds_of: DeformedShape | BodyState | None = None
        self._pose_of: BodyState | None = None
        self._radius_of: Float | None = None
        self._radius_m = 0.0
        self._stored_energy = 0.0
        self._deforming_time = self._settle_time = self._sleep_time = self._stood = 0.0

    @property
    def T_world_object(self) -> Float:
        """[4, 4] pose; while deforming, the best-fitting rigid pose of all its particles."""
        if self.state is not None:
            return self._nearest_pose(self.state).copy()
        pose = np.eye(4)
        pose[:3, :3] = self.motion.rotation
        pose[:3, 3] = self.motion.centre - self.motion.rotation @ self._local_centre
        return pose

    def _nearest_pose(self, state: BodyState) -> Float:
        """[4, 4] best-fitting rigid pose; read-only."""
        if self._pose_of is not state:
            rotation = best_rotation(self.rest.positions, state.positions, self.rest.masses)
            self._pose_of, self._pose = state, np.eye(4)
            self._pose[:3, :3] = rotation
            self._pose[:3, 3] = state.centre - rotation @ self.rest.centre_of_mass
        return self._pose

    def local_positions(self) -> Float:
        """[N, 3] particle positions in the frame of ``T_world_object`` [m]."""
        if self.state is None:
            return self.shape.positions
        pose = self.T_world_object
        return (self.state.positions - pose[:3, 3]) @ pose[:3, :3]

    def hull_points(self) -> Float:
        """[K, 3] outermost particles, world frame [m]; used for contact with half-spaces."""
        return self._world(self._hull, 0)

    def shell_points(self) -> Float:
        """[K, 3] all surface particles, world frame [m]."""
        return self._world(self._shell, 1)

    def _world(self, which: NDArray[np.int64], kind: int) -> Float:
        if self.state is not None:
            return self.state.positions[which]
        if self._outlines_of is not self.shape:
            self._outlines_of, p = self.shape, self.shape.positions - self._local_centre
            self._outlines = p[self._hull], p[self._shell]
        placed: Float = self._outlines[kind] @ self.motion.rotation.T + self.motion.centre
        return placed

    def box(self) -> tuple[Float, Float]:
        """Pose [4, 4] and size [3] of the box around its current shape."""
        kept = self.shape if self.state is None else self.state
        if self._bounds_of is not kept:
            local, half = self.local_positions(), self.spacing / 2
            low, high = local.min(axis=0) - half, local.max(axis=0) + half
            self._bounds_of, self._bounds = kept, ((low + high) / 2, high - low)
        middle, size = self._bounds
        pose = self.T_world_object
        pose[:3, 3] += pose[:3, :3] @ middle
        return pose, size.copy()

    def gap_to(self, other: DeformableBody) -> float:
        """A lower bound of the distance between the boxes of two bodies [m]; negative inside."""
        apart = float(np.linalg.norm(self.motion.centre - other.motion.centre))
        apart -= self.reach + other.reach + CORNER * (self.spacing + other.spacing)
        if apart > NEAR_MAX:
            return apart
        return -float(box_penetration(*self.box(), *other.box()))

    def gap_to_colliders(self, colliders: Sequence[Collider]) -> tuple[float, float]:
        """Distance [m] to the nearest collider, and the closing speed there [m/s].

        Infinite for solids beyond NEAR_MAX.
        """
        gap, approach, _ = self._closest(colliders, within=NEAR_MAX, ahead=0.0)
        return gap, approach

    def meets(self, colliders: Sequence[Collider], *, within: float, ahead: float) -> bool:
        """Whether a collider is approaching and will be ``within`` [m] in time ``ahead`` [s]."""
        return self._closest(colliders, within=within, ahead=ahead)[2]

    def _closest(
        self, colliders: Sequence[Collider], *, within: float, ahead: float
    ) -> tuple[float, float, bool]:
        """See ``rigid.closest``.

        Ground contact uses the outermost particles; a solid may touch any point of a flat side.
        """
        smooth = [c for c in colliders if not isinstance(c, Solid)]
        hull = np.inf, 0.0, False
        if smooth:
            hull = closest(self.hull_points(), self.motion, smooth, within=within, ahead=ahead)
        solids = [c for c in colliders if isinstance(c, Solid)]
        solids = self._within_reach(solids, within, ahead) if solids else solids
        if not solids:
            return hull
        shell = closest(self.shell_points(), self.motion, solids, within=within, ahead=ahead)
        gap, approach, _ = min(hull, shell)
        return gap, approach, hull[2] or shell[2]

    def _within_reach(self, solids: Sequence[Solid], within: float, ahead: float) -> list[Solid]:
        """Solids close enough to the box of the body for an exact comparison of surfaces."""
        gaps, speeds = solid_gaps(*self.box(), solids)
        m = self.motion
        speed = float(np.linalg.norm(m.velocity))
        speed += self.reach * float(np.linalg.norm(m.angular_velocity))
        near = gaps < within + (speed + speeds) * ahead
        return [solid for solid, is_near in zip(solids, near.tolist(), strict=True) if is_near]

    @property
    def _local_centre(self) -> Float:
        """[3] centre of mass in the current shape, body frame [m]."""
        if self._centre_of is not self.shape:
            self._centre_of = self.shape
            self._centre: Float = self.rest.masses @ self.shape.positions / self.rest.mass
        return self._centre

    @property
    def reach(self) -> float:
        """Radius of the bounding sphere around the centre of mass [m]."""
        positions = self.shape.positions if self.state is None else self.state.positions
        if self._radius_of is not positions:
            centre = self.rest.masses @ positions / self.rest.mass
            self._radius_of = positions
            self._radius_m = float(np.linalg.norm(positions - centre, axis=1).max())
        return self._radius_m

    def solver_body(self) -> Body:
        """The current body for a solver, with the velocities of its rigid motion."""
        if self.state is not None:
            s = self.state
            return self._solver_body(s.positions, s.velocities, s.gradients, s)
        self._carried = self._on_grid(self.motion)
        pose, rotation = self.T_world_object, self.motion.rotation
        positions = apply_transform(pose, self.shape.positions)
        spin = cross_matrix(self.motion.angular_velocity)
        velocities = self.motion.velocity + (positions - self.motion.centre) @ spin.T
        shape = replace(
            self.shape,
            F_elastic=rotation @ self.shape.F_elastic,
            F_total=rotation @ self.shape.F_total,
        )
        return self._solver_body(
            positions, velocities, np.tile(spin, (len(positions), 1, 1)), shape
        )

    def _solver_body(
        self,
        positions: Float,
        velocities: Float,
        gradients: Float,
        shape: DeformedShape | BodyState,
    ) -> Body:
        return Body(
            name=self.name,
            particles=replace(self.rest, positions=positions),
            material=self.materials,
            regions=self.regions,
            friction=self.friction,
            particle_velocities=velocities,
            particle_gradients=gradients,
            deformation=shape.F_elastic,
            total_deformation=shape.F_total,
            history=shape.history,
        )

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy [J]."""
        if self.state is None:
            return self.motion.kinetic
        turning = self.motion.angular_velocity
        return self.state.kinetic - self._added_inertia * float(turning @ turning) / 2

    @property
    def elastic_energy(self) -> float:
        """Elastic energy of the deformation [J]."""
        return self._stored_energy if self.state is None else self.state.elastic

    def advance_rigid(
        self, duration: float, gravity: Float, road: Sequence[Collider]
    ) -> TyreReaction | None:
        """Advance the rigid motion (falling, rolling, sliding) by ``duration`` [s].

        Args:
            duration: [s].
            gravity: [3] [m/s^2].
            road: colliders that support tyres.

        Returns:
            Reaction of the road; None without tyres.
        """
        steps = math.ceil(duration / RIGID_STEP - 1e-6)
        dt = duration / steps
        m, wheels = self.motion, self.tyres or NO_TYRES
        rotation = np.array(m.rotation)
        moved = np.array([m.centre, m.velocity, m.angular_velocity])
        impulse = np.zeros(3)
        rows, heights = packed(tuple(road))
        friction_work = advance_on_wheels(
            rotation,
            moved,
            m.mass,
            m.inertia,
            -self._local_centre,
            wheels.patches,
            wheels.static_load,
            wheels.rest,
            wheels.parameters,
            rows,
            heights,
            gravity,
            dt,
            steps,
            impulse,
        )
        m = self.motion = replace(
            m, rotation=rotation, centre=moved[0], velocity=moved[1], angular_velocity=moved[2]
        )
        self._stood = self._settle_time
        if self.tyres is not None:
            self.note_standing(duration)
        return None if self.tyres is None else TyreReaction(impulse, friction_work)

    def note_standing(self, duration: float) -> None:
        """Add ``duration`` [s] to the time for which a supported rigid body has hardly moved."""
        m = self.motion
        slow = np.linalg.norm(m.velocity) + np.linalg.norm(m.angular_velocity) < SLEEP_SPEED / 2
        self._settle_time = self._stood + duration if slow else 0.0

    def activate(self) -> None:
        """Switch to deforming mode; the next ``solver_body`` is for a solver."""
        self.mode = BodyMode.DEFORMING
        self._velocity_before = self.motion.velocity
        self._deforming_time = self._settle_time = self._sleep_time = 0.0

    def update_from_solver(self, state: BodyState) -> None:
        """Take over the solver state of this body; its rigid part becomes the motion.

        On the grid, particles have extra rotational inertia. The body therefore tracks angular
        momentum itself and applies the change seen on the grid.
        """
        spin = self.motion.angular_momentum + state.angular_momentum - self._carried
        self._carried = state.angular_momentum
        self.state = replace(state, angular_momentum=spin)
        rest = self.rest
        inertia = inertia_about(state.centre, state.positions, rest.masses, rest.volumes)
        self.motion = RigidMotion(
            rotation=np.eye(3),
            centre=state.centre,
            velocity=state.velocity,
            angular_velocity=np.asarray(np.linalg.solve(inertia, spin)),
            mass=state.mass,
            inertia=inertia,
        )

    def _on_grid(self, motion: RigidMotion) -> Float:
        """[3] angular momentum of the particles on the grid for a rigid motion."""
        return motion.angular_momentum + self._added_inertia * motion.angular_velocity

    @property
    def lag(self) -> Float:
        """[3] deficit of its angular velocity on the grid against its angular momentum [rad/s]."""
        m = self.motion
        inertia = m.world_inertia + self._added_inertia * np.eye(3)
        return np.asarray(np.linalg.solve(inertia, self._on_grid(m) - self._carried), np.float64)

    def catch_up(self) -> None:
        """Set the particles' rotation to its angular momentum; the solver must restart."""
        self._change(np.zeros(3), self.lag)
        self._carried = self._on_grid(self.motion)

    def apply_road(self, road: Sequence[Collider], duration: float) -> TyreReaction | None:
        """Apply the road's forces to the wheels while deforming, as on a rigid body.

        Returns:
            Reaction of the road, or None if no wheel carries load. If not None, the solver must
            restart from this body.
        """
        if self.tyres is None:
            return None
        after, reaction = self.tyres.apply(self.motion, self.T_world_object, road, duration)
        if not np.any(reaction.impulse):
            return None
        self.apply_impulse(after)
        return reaction

    def apply_impulse(self, after: RigidMotion) -> None:
        """Apply the rigid velocity change from the current motion to ``after`` to all particles."""
        assert self.state is not None
        m = self.motion
        self._change(after.velocity - m.velocity, after.angular_velocity - m.angular_velocity)
        self._carried = self._carried + self._on_grid(after) - self._on_grid(m)
        self.state = replace(
            self.state, momentum=after.momentum, angular_momentum=after.angular_momentum
        )
        self.motion = after

    def _change(self, velocity: Float, turning: Float) -> None:
        """Add a rigid motion to all particles: [3] of the centre [m/s], and [3] [rad/s]."""
        assert self.state is not None
        s, spin = self.state, cross_matrix(turning)
        self.state = replace(
            s,
            velocities=s.velocities + velocity + (s.positions - s.centre) @ spin.T,
            gradients=s.gradients + spin,
        )

    def brake_after_hit(self, fraction: float) -> None:
        """Brake the wheels permanently, with ``fraction`` of their grip."""
        assert self.tyres is not None
        self.hit = True
        self.tyres = self.tyres.braked(fraction)

    def residual_speed(self) -> float:
        """RMS speed of particles relative to the rigid motion [m/s]."""
        assert self.state is not None
        s, m = self.state, self.motion
        rigid = m.velocity + np.cross(m.angular_velocity, s.positions - s.centre)
        return float(np.sqrt(self.rest.masses @ ((s.velocities - rigid) ** 2).sum(axis=1) / m.mass))

    def update_timers(self, duration: float) -> None:
        """Add ``duration`` [s] to the timers for deforming, settled and slow."""
        speed = float(np.linalg.norm(self.motion.velocity))
        turning = float(np.linalg.norm(self.motion.angular_velocity))
        settled = self.residual_speed() < max(SETTLED_SPEED, SETTLED_FRACTION * speed)
        # A stiff body hardly deforms even in the middle of an impact.
        self.acceleration = (self.motion.velocity - self._velocity_before) / duration
        self._velocity_before = self.motion.velocity
        settled = settled and float(np.linalg.norm(self.acceleration)) < JOLT
        slow = speed + turning < SLEEP_SPEED
        self._deforming_time += duration
        self._settle_time = self._settle_time + duration if settled else 0.0
        self._sleep_time = self._sleep_time + duration if slow else 0.0

    @property
    def is_undamped(self) -> bool:
        """Whether the body is purely elastic, without any dissipation."""
        return all(m.viscosity == 0 and not m.plastic for m in self.materials)

    @property
    def may_rigidify(self) -> bool:
        """Whether the body has been deforming and settled for long enough."""
        return self._settle_time >= SETTLE_TIME and self._deforming_time >= 2 * SETTLE_TIME

    @property
    def may_sleep(self) -> bool:
        """Whether the body has also been nearly still for long enough."""
        return self.may_rigidify and self._sleep_time > SLEEP_TIME

    def rigidify(self) -> None:
        """Become rigid in the current shape, conserving momentum and angular momentum."""
        assert self.state is not None
        pose, s = self.T_world_object, self.state
        back = pose[:3, :3].T
        self.shape = DeformedShape(
            (s.positions - pose[:3, 3]) @ pose[:3, :3],
            back @ s.F_elastic,
            back @ s.F_total,
            s.history,
        )
        m = self.motion
        self.motion = replace(
            m, rotation=pose[:3, :3], inertia=back @ m.world_inertia @ pose[:3, :3]
        )
        self._stored_energy = s.elastic
        self.acceleration = np.zeros(3)
        self.state, self.mode, self._settle_time = None, BodyMode.RIGID, 0.0

    @property
    def has_parked(self) -> bool:
        """Whether a rigid body has been still for long enough to sleep."""
        return self._settle_time > WHEELS_SLEEP_TIME

    def put_to_sleep(self, supports: Sequence[str] = ()) -> None:
        """Put the body to sleep until another one approaches or its support moves.

        A deforming body becomes rigid first.

        Args:
            supports: names of the bodies or colliders that it rests on.
        """
        self.supports = frozenset(supports)
        if self.state is not None:
            self.rigidify()
        self.mode, self._settle_time = BodyMode.SLEEPING, 0.0
        self.motion = replace(self.motion, velocity=np.zeros(3), angular_velocity=np.zeros(3))

    def wake(self) -> None:
        """Wake the body."""
        self.mode = BodyMode.RIGID

    def push(self, impulse: Float, moment: Float) -> None:
        """Apply an impulse to a rigid body and wake it.

        Args:
            impulse: [3] [N s].
            moment: [3] moment of the impulse about the world origin [N m s].
        """
        m = self.motion
        turn = np.linalg.solve(m.world_inertia, moment - np.cross(m.centre, impulse))
        self.motion = replace(
            m, velocity=m.velocity + impulse / m.mass, angular_velocity=m.angular_velocity + turn
        )
        if self.mode == BodyMode.SLEEPING:
            self.wake()

    def translate(self, by: Float) -> None:
        """Shift a rigid body by ``by`` [3] [m]."""
        self.motion = replace(self.motion, centre=self.motion.centre + by)


def _undeformed(particles: Particles) -> DeformedShape:
    n = len(particles)
    eye = np.tile(np.eye(3), (n, 1, 1))
    return DeformedShape(particles.positions, eye, eye, np.zeros(n))


def _shell(positions: Float, spacing: float) -> NDArray[np.int64]:
    """Indices of particles without a neighbour on at least one of their six sides."""
    from scipy.spatial import cKDTree

    neighbours = cKDTree(positions).query_ball_point(
        positions, NEIGHBOUR_SPACINGS * spacing, return_length=True
    )
    shell: NDArray[np.int64] = np.flatnonzero(neighbours < 7)
    return shell


def _hull(positions: Float) -> NDArray[np.int64]:
    """Indices of the outermost particles along evenly distributed directions."""
    k = np.arange(SURFACE_POINTS) + 0.5
    z = 1 - 2 * k / SURFACE_POINTS
    radius, angle = np.sqrt(1 - z * z), np.pi * (1 + 5**0.5) * k
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    scaled = positions / np.maximum(np.ptp(positions, axis=0), 1e-9)
    return np.unique((scaled @ directions.T).argmax(axis=0))
