"""Tyres: four patches that carry, roll and grip."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..geometry.rotation import Float
from ..physics.colliders import Collider
from .rigid import RigidMotion
from .rolling import ROLLING, STATIC_GRAVITY, UPRIGHT, press
from .surroundings import clearance, nearest, packed

ABOVE_MAX = 0.1
"""Tracked boxes of standing vehicles are at most this high above the road [m]."""
TRACK = 0.84
"""Over the width of the box."""
LIFT_MAX = 0.3
"""Wheels never go further into their arches than this [m]."""


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
        length, _, height = size
        x, y = 0.3 * length, track_of(size) / 2
        patches = np.array([[a * x, b * y, -height / 2] for a in (1, -1) for b in (1, -1)])
        front = np.clip((centre[0] + x) / (2 * x), 0.2, 0.8)
        left = np.clip((centre[1] + y) / (2 * y), 0.2, 0.8)
        fractions = np.array([f * s for f in (front, 1 - front) for s in (left, 1 - left)])
        return cls(patches, weight * fractions, friction=friction, brake=brake)

    def standing(self, T_world_object: Float, road: Sequence[Collider]) -> Tyres:
        """Tyres whose rest is how the vehicle stands now, where wheels are about on the road.

        Tracked boxes miss the road by a few centimetres; that is no reason to jump. What is higher
        up falls.
        """
        heights, _ = nearest(road, self._points(T_world_object))
        near = (heights < ABOVE_MAX) & (heights > -LIFT_MAX)
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

    def carrying(
        self, T_world_object: Float, road: Sequence[Collider]
    ) -> Iterator[tuple[Collider, Float, Float]]:
        """What carries each wheel that is not in the air, where [3] [m], and its normal [3]."""
        points = self._points(T_world_object)
        droop = STATIC_GRAVITY / (2 * np.pi * self.frequency) ** 2
        over = [clearance(collider, points) for collider in road]
        for wheel, point in enumerate(points):
            k = int(np.argmin([heights[wheel] for heights, _ in over]))
            heights, normals = over[k]
            upright = normals[wheel] @ T_world_object[:3, 2] > UPRIGHT
            if upright and self.rest[wheel] - heights[wheel] > -droop:
                yield road[k], point, normals[wheel]

    def grip_along(self, direction: Float, forward: Float) -> float:
        """Most friction over load along a direction [3] on the road; less where a wheel rolls."""
        held = max(self.brake * self.friction, ROLLING)
        return min(self.friction, held / max(abs(float(direction @ forward)), 1e-9))

    def apply(
        self,
        motion: RigidMotion,
        T_world_object: Float,
        road: Sequence[Collider],
        duration: float,
    ) -> tuple[RigidMotion, TyreReaction]:
        """What the road does to the body over ``duration`` [s] through its tyres.

        See ``rolling.press``.

        Returns:
            The motion after, and what the road did.
        """
        moved = np.array([motion.centre, motion.velocity, motion.angular_velocity])
        impulse = np.zeros(3)
        rows, heights = packed(tuple(road))
        friction_work = press(
            self._points(T_world_object),
            np.array(T_world_object[:3, 2]),
            np.array(T_world_object[:3, 0]),
            moved,
            motion.mass,
            np.linalg.inv(motion.world_inertia),
            self.static_load,
            self.rest,
            self.parameters,
            rows,
            heights,
            duration,
            impulse,
        )
        after = replace(motion, velocity=moved[1], angular_velocity=moved[2])
        return after, TyreReaction(impulse, friction_work)

    @cached_property
    def parameters(self) -> Float:
        """[5] what kernels take, see ``rolling``."""
        return np.array([self.friction, self.brake, self.frequency, self.damping, self.travel])

    def _points(self, T_world_object: Float) -> Float:
        return self.patches @ T_world_object[:3, :3].T + T_world_object[:3, 3]


def track_of(size: Sequence[float]) -> float:
    """Distance between left and right wheels under a box of ``size`` [m]."""
    return TRACK * size[1]
