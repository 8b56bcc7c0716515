"""One object of a scene as a body: rigid while alone, matter while it deforms, dented after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..geometry.box import box_penetration
from ..geometry.rotation import Float
from ..geometry.transform import apply_transform
from ..physics.body import Body
from ..physics.colliders import Collider
from ..physics.materials import Material
from ..physics.particles import Particles
from ..physics.solver import BodyState
from .rigid import RigidMotion, best_rotation, cross_matrix, inertia_about
from .surroundings import nearest
from .tyres import Tyres

SLEEPING, RIGID, DEFORMING = range(3)
MODES = ("resting", "rigid", "deforming")
SURFACE_POINTS = 600


@dataclass(frozen=True, eq=False)
class Shape:
    """What deformation has left, in the object's frame.

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
    """A body of a simulation and how it moves now.

    Args:
        name: object id.
        particles: at rest, object frame.
        materials, regions: see :class:`~..body.Body`.
        friction: of its surface.
        cell: of the solver's grid [m].
        T_world_object: [4, 4] at the start.
        velocity: [3] of the centre of mass [m/s].
        angular_velocity: [3] world axes [rad/s].
        tyres: when it stands on wheels.
    """

    def __init__(
        self,
        name: str,
        particles: Particles,
        materials: Sequence[Material],
        regions: Any,
        *,
        friction: float,
        cell: float,
        T_world_object: Float,
        velocity: Float,
        angular_velocity: Float,
        tyres: Tyres | None = None,
    ) -> None:
        n = len(particles)
        self.name = name
        self.rest = particles
        self.materials = tuple(materials)
        self.regions = regions
        self.friction = friction
        self.cell = cell
        self.tyres = tyres
        eye = np.tile(np.eye(3), (n, 1, 1))
        self.shape = Shape(particles.positions, eye, eye, np.zeros(n))
        self.spacing = float(np.cbrt(np.median(particles.volumes)))
        self._stiff_pose = np.array(T_world_object, dtype=np.float64)
        centre = apply_transform(self._stiff_pose, particles.centre_of_mass[None])[0]
        self.motion = RigidMotion(
            rotation=self._stiff_pose[:3, :3],
            centre=centre,
            velocity=np.array(velocity, dtype=np.float64),
            angular_velocity=np.array(angular_velocity, dtype=np.float64),
            mass=particles.mass,
            inertia=inertia_about(
                particles.centre_of_mass, particles.positions, particles.masses, cell=cell
            ),
        )
        self._sample = _outer_points(particles.positions)
        self.mode = RIGID
        self.deforming_for = 0.0
        self.calm_for = self.still_for = 0.0
        self.hit = False
        self.state: BodyState | None = None
        self.stored = 0.0

    @property
    def T_world_object(self) -> Float:
        """[4, 4] pose; while deforming, the rigid pose nearest to all its matter."""
        pose = np.eye(4)
        if self.state is None:
            local_centre = self.rest.masses @ self.shape.positions / self.rest.mass
            pose[:3, :3] = self.motion.rotation
            pose[:3, 3] = self.motion.centre - self.motion.rotation @ local_centre
            return pose
        rotation = best_rotation(self.rest.positions, self.state.positions, self.rest.masses)
        pose[:3, :3] = rotation
        pose[:3, 3] = self.state.centre - rotation @ self.rest.centre_of_mass
        return pose

    def local_positions(self) -> Float:
        """[N, 3] particles in the frame of ``T_world_object`` [m]."""
        if self.state is None:
            return self.shape.positions
        pose = self.T_world_object
        return (self.state.positions - pose[:3, 3]) @ pose[:3, :3]

    def outer_points(self) -> Float:
        """[K, 3] some particles of the outside, in the world [m]."""
        if self.state is not None:
            return self.state.positions[self._sample]
        return apply_transform(self.T_world_object, self.shape.positions[self._sample])

    def box(self) -> tuple[Float, Float]:
        """Pose [4, 4] and size [3] of the box about its present shape."""
        local = self.local_positions()
        low, high = local.min(axis=0) - self.spacing / 2, local.max(axis=0) + self.spacing / 2
        pose = self.T_world_object
        pose[:3, 3] += pose[:3, :3] @ ((low + high) / 2)
        return pose, high - low

    def gap_to(self, other: DeformableBody) -> float:
        """A lower bound of the distance between the boxes of two bodies [m]; below 0 inside."""
        return -float(box_penetration(*self.box(), *other.box()))

    def gap_to_colliders(self, colliders: Sequence[Collider]) -> tuple[float, float]:
        """Distance [m] to the nearest collider, and the speed of approach there [m/s]."""
        points = self.outer_points()
        distance, normals = nearest(colliders, points)
        k = int(distance.argmin())
        if not np.isfinite(distance[k]):
            return np.inf, 0.0
        return float(distance[k]), -float(normals[k] @ self.motion.velocity_at(points[k]))

    def body(self) -> Body:
        """The body as it is now, for a solver; momentum and angular momentum are the motion's."""
        if self.state is not None:
            s = self.state
            return self._body(s.positions, s.velocities, s.gradients, s)
        pose, rotation = self.T_world_object, self.motion.rotation
        positions = apply_transform(pose, self.shape.positions)
        turn = cross_matrix(self.motion.angular_velocity)
        velocities = self.motion.velocity + (positions - self.motion.centre) @ turn.T
        shape = replace(
            self.shape,
            F_elastic=rotation @ self.shape.F_elastic,
            F_total=rotation @ self.shape.F_total,
        )
        return self._body(positions, velocities, np.tile(turn, (len(positions), 1, 1)), shape)

    def _body(
        self, positions: Float, velocities: Float, gradients: Float, shape: Shape | BodyState
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

    def loosen(self) -> None:
        """Turn into deforming matter; the next ``body`` goes into a solver."""
        self.mode, self.deforming_for = DEFORMING, 0.0
        self.calm_for = self.still_for = 0.0

    def take(self, state: BodyState) -> None:
        """The solver's state of this body; the motion becomes its rigid part."""
        self.state = state
        inertia = inertia_about(state.centre, state.positions, self.rest.masses, cell=self.cell)
        # The state's angular momentum is about its centre, spin of particles included.
        self.motion = RigidMotion(
            rotation=np.eye(3),
            centre=state.centre,
            velocity=state.velocity,
            angular_velocity=np.linalg.solve(inertia, state.angular_momentum),
            mass=state.mass,
            inertia=inertia,
        )

    def kick(self, after: RigidMotion) -> None:
        """Give all particles the rigid change of velocity from the present motion to ``after``."""
        assert self.state is not None
        s, m = self.state, self.motion
        turn = cross_matrix(after.angular_velocity - m.angular_velocity)
        self.state = replace(
            s,
            velocities=s.velocities
            + (after.velocity - m.velocity)
            + (s.positions - s.centre) @ turn.T,
            gradients=s.gradients + turn,
            momentum=after.momentum,
            angular_momentum=after.angular_momentum,
        )
        self.motion = after

    def unrest(self) -> float:
        """Root mean square speed of particles against the rigid part of their motion [m/s]."""
        assert self.state is not None
        s, m = self.state, self.motion
        rigid = m.velocity + np.cross(m.angular_velocity, s.positions - s.centre)
        return float(np.sqrt(self.rest.masses @ ((s.velocities - rigid) ** 2).sum(axis=1) / m.mass))

    def stiffen(self, mode: int) -> None:
        """Become rigid as it is: no particle moves; momentum and angular momentum stay."""
        assert self.state is not None
        pose, s = self.T_world_object, self.state
        back = pose[:3, :3].T
        self.shape = Shape(
            (s.positions - pose[:3, 3]) @ pose[:3, :3],
            back @ s.F_elastic,
            back @ s.F_total,
            s.history,
        )
        m = self.motion
        self.motion = replace(
            m, rotation=pose[:3, :3], inertia=back @ m.world_inertia @ pose[:3, :3]
        )
        self.stored = s.elastic
        self.state, self.mode, self.calm_for = None, mode, 0.0
        if mode == SLEEPING:
            self.lay_down()

    def lay_down(self) -> None:
        """Stand still until something comes near."""
        self.mode, self.calm_for = SLEEPING, 0.0
        self.motion = replace(self.motion, velocity=np.zeros(3), angular_velocity=np.zeros(3))


def _outer_points(positions: Float) -> Any:
    """Indices of particles that lie outermost along evenly spread directions."""
    k = np.arange(SURFACE_POINTS) + 0.5
    z = 1 - 2 * k / SURFACE_POINTS
    radius, angle = np.sqrt(1 - z * z), np.pi * (1 + 5**0.5) * k
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    scaled = positions / np.maximum(np.ptp(positions, axis=0), 1e-9)
    return np.unique((scaled @ directions.T).argmax(axis=0))
