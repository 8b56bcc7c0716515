"""Tyres: four patches that carry, roll and grip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..geometry.rotation import Float
from ..physics.colliders import Collider
from .rigid import RigidMotion
from .surroundings import nearest

ROLLING = 0.015
"""Rolling resistance of a free wheel, fraction of its load."""
ROUNDS = 6
"""Sweeps over the four patches in one step; their impulses act on each other."""
LIFT_MAX = 0.3
"""Wheels never go further into their arches than this [m]."""
UPRIGHT = 0.5
"""Wheels carry while the body's up axis leans less than 60 degrees from the ground's normal."""


@dataclass(frozen=True, eq=False)
class TyreReaction:
    """What the road did to a body through its tyres in one step.

    Attributes:
        impulse: [3] on the body [N s].
        friction_work: dissipated by slip [J].
    """

    impulse: Float
    friction_work: float


@dataclass(frozen=True, eq=False)
class Tyres:
    """Four wheels of a vehicle, and the road they stand on.

    Attributes:
        patches: [4, 3] undersides of the wheels in the object's frame, as they stand at rest [m].
        static_load: [4] what each carries at rest [N].
        friction: of rubber on the road.
        brake: fraction of the wheels' grip that holds against rolling, 0 rolls freely, 1 locks.
        frequency: of the body on its springs [Hz].
        damping: fraction of critical.
        travel: by which springs give in beyond rest before the body strikes through [m].
        rest: [4] height of the undersides above the road at which they carry ``static_load`` [m].
    """

    patches: Float
    static_load: Float
    friction: float = 0.7
    brake: float = 0.0
    frequency: float = 2.0
    damping: float = 0.35
    travel: float = 0.12
    rest: Float = field(default_factory=lambda: np.zeros(4))

    @classmethod
    def of(
        cls,
        size: Sequence[float],
        centre: Float,
        weight: float,
        *,
        friction: float = 0.7,
        brake: float = 0.0,
    ) -> Tyres:
        """Wheels under a box of ``size`` [m], axles at 30 % of the length from the middle.

        Args:
            size: (length, width, height).
            centre: [3] centre of mass in the object's frame [m].
            weight: mass times gravity [N].
            friction, brake: see the class.
        """
        length, width, height = size
        x, y = 0.3 * length, 0.42 * width
        patches = np.array([[a * x, b * y, -height / 2] for a in (1, -1) for b in (1, -1)])
        front = np.clip((centre[0] + x) / (2 * x), 0.2, 0.8)
        left = np.clip((centre[1] + y) / (2 * y), 0.2, 0.8)
        fractions = np.array([f * s for f in (front, 1 - front) for s in (left, 1 - left)])
        return cls(patches, weight * fractions, friction=friction, brake=brake)

    def standing(self, T_world_object: Float, road: Sequence[Collider], reach: float) -> Tyres:
        """Tyres whose rest is how the vehicle stands now, where that is within ``reach`` [m].

        Tracked boxes miss the road by a few centimetres; that is no reason to jump.
        """
        heights, _ = nearest(road, self._points(T_world_object))
        near = np.abs(heights) < reach
        return replace(self, rest=np.where(near.all(), heights, np.zeros(4)))

    def braked(self, fraction: float) -> Tyres:
        """The same with ``fraction`` of their grip braked, in [0, 1]."""
        return replace(self, brake=fraction)

    def lifts(self, T_world_object: Float, road: Sequence[Collider]) -> Float:
        """[4] by how far springs have given in, so that wheels stand on the road, not in it [m]."""
        heights, normals = nearest(road, self._points(T_world_object))
        carrying = np.isfinite(heights) & (normals @ T_world_object[:3, 2] > UPRIGHT)
        squeeze = np.where(carrying, self.rest - heights, 0.0)
        return np.clip(squeeze, 0.0, LIFT_MAX)

    def apply(
        self,
        motion: RigidMotion,
        T_world_object: Float,
        road: Sequence[Collider],
        duration: float,
    ) -> tuple[RigidMotion, TyreReaction]:
        """What the road does to the body over ``duration`` [s] through its tyres.

        Springs and dampers carry along the normal. Across it each patch stops its slip as far as
        its friction circle lets it: sideways always, along the wheel as far as it is braked.

        Returns:
            The motion after, and what the road did.
        """
        points = self._points(T_world_object)
        up = T_world_object[:3, 2]
        heights, normals = nearest(road, points)
        loads = self._loads(motion, points, heights, normals, duration)
        loads = np.where(normals @ up > UPRIGHT, loads, 0.0)
        before, total, friction_work = motion, np.zeros(3), 0.0
        for point, normal, load in zip(points, normals, loads, strict=True):
            motion = motion.with_impulse(load * normal, point)
            total += load * normal
        used = np.zeros((4, 2))
        forward = T_world_object[:3, 0]
        for _ in range(ROUNDS):
            for k in np.flatnonzero(loads > 0):
                motion, used[k], impulse = self._grip(
                    motion, points[k], normals[k], forward=forward, load=loads[k], used=used[k]
                )
                total += impulse
                slip = (motion.velocity_at(points[k]) + before.velocity_at(points[k])) / 2
                friction_work -= float(impulse @ slip)
        return motion, TyreReaction(total, max(friction_work, 0.0))

    def _points(self, T_world_object: Float) -> Float:
        return self.patches @ T_world_object[:3, :3].T + T_world_object[:3, 3]

    def _loads(
        self, motion: RigidMotion, points: Float, heights: Float, normals: Float, duration: float
    ) -> Float:
        """Impulses [4] of springs and dampers along the normals [N s]."""
        omega = 2 * np.pi * self.frequency
        mass = self.static_load / 9.81
        squeeze = np.minimum(self.rest - heights, 2 * self.travel)
        speed = np.array([n @ motion.velocity_at(p) for p, n in zip(points, normals, strict=True)])
        force = self.static_load + mass * omega**2 * squeeze
        force -= 2 * self.damping * omega * mass * speed
        droop = self.static_load / (mass * omega**2)
        return np.where(squeeze > -droop, np.maximum(force, 0), 0) * duration

    def _grip(
        self,
        motion: RigidMotion,
        point: Float,
        normal: Float,
        *,
        forward: Float,
        load: float,
        used: Float,
    ) -> tuple[RigidMotion, Float, Float]:
        """One patch: more impulse across the road, within its friction circle."""
        along = forward - (forward @ normal) * normal
        along /= max(float(np.linalg.norm(along)), 1e-9)
        side = np.cross(normal, along)
        v = motion.velocity_at(point)
        axes = np.stack([along, side])
        slip = axes @ v
        arm = point - motion.centre
        inertia = motion.world_inertia
        bends = [a @ np.cross(np.linalg.solve(inertia, np.cross(arm, a)), arm) for a in axes]
        wanted = used - slip / (1 / motion.mass + np.array(bends))
        held = max(self.brake * self.friction, ROLLING) * load
        wanted[0] = np.clip(wanted[0], -held, held)
        size = float(np.linalg.norm(wanted))
        wanted *= min(1.0, self.friction * load / max(size, 1e-12))
        impulse = (wanted - used) @ axes
        return motion.with_impulse(impulse, point), wanted, impulse
