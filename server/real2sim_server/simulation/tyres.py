"""Tyres: four contact patches with suspension and friction, and rigid motion on them."""

# Kernels take arrays by position: Numba has no keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._numba import func, kernel
from ..geometry import Float
from ..physics.colliders import Collider
from ..physics.contact import collider_distance
from .rigid import RigidMotion, clearance, nearest, packed

# Compiled rigid motion on tyres: road forces on four patches, and body motion.


ROLLING = 0.015
"""Rolling resistance of a free wheel, fraction of its load."""
ROUNDS = 6
"""Sweeps over the four patches in one step; the impulses of patches affect each other."""
UPRIGHT = 0.5
"""Minimum cosine between the body's up axis and the road's normal for loaded wheels (60 degrees).
"""
STATIC_GRAVITY = 9.81
"""Gravity by which static loads are divided for the mass on a wheel [m/s^2]."""
FRICTION, BRAKE, FREQUENCY, DAMPING, TRAVEL = range(5)
"""Columns of a row of tyre parameters, see ``Tyres``."""


@kernel
def advance_on_wheels(
    rotation: Any, motion: Any, mass: Any, inertia: Any, origin: Any,
    patches: Any, static_load: Any, rest: Any, tyres: Any, rows: Any, heights: Any,
    gravity: Any, dt: Any, steps: Any, impulse: Any,
) -> Any:  # fmt: skip
    """Advance a rigid body by ``steps`` of ``dt`` [s], in place; symplectic Euler.

    Args:
        rotation: [3, 3] object to world; updated.
        motion: [3, 3] rows centre, velocity and angular velocity; updated.
        mass, inertia: see ``RigidMotion``.
        origin: [3] vector from the centre of mass to the object's origin, object frame [m].
        patches, static_load, rest: see ``Tyres``; [0, 3], [0], [0] without tyres.
        tyres: [5] tyre parameters.
        rows, heights: packed colliders that support tyres.
        gravity: [3] [m/s^2].
        impulse: [3] the impulse of the road is added to it [N s].

    Returns:
        Energy dissipated by tyre slip [J].
    """
    friction_work = 0.0
    points = np.empty_like(patches)
    own = np.linalg.inv(inertia)
    up, forward = np.empty(3), np.empty(3)
    for _ in range(steps):
        for axis in range(3):
            motion[1, axis] += dt * gravity[axis]
            up[axis], forward[axis] = rotation[axis, 2], rotation[axis, 0]
        for k in range(len(patches)):
            for axis in range(3):
                points[k, axis] = motion[0, axis]
                for j in range(3):
                    points[k, axis] += rotation[axis, j] * (patches[k, j] + origin[j])
        if len(patches):
            friction_work += press(
                points, up, forward, motion, mass, rotation @ own @ rotation.T,
                static_load, rest, tyres, rows, heights, dt, impulse,
            )  # fmt: skip
        drift(rotation, motion, inertia, own, dt)
    return friction_work


@func
def drift(rotation: Any, motion: Any, inertia: Any, inverse: Any, dt: Any) -> None:
    """Move a body at its velocities for ``dt`` [s]; conserves angular momentum."""
    spin = motion[2].copy()
    momentum = rotation @ (inertia @ (rotation.T @ spin))
    angle = dt * math.sqrt(spin @ spin)
    if angle > 1e-12:
        x, y, z = dt * spin / angle
        k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turned = (np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)) @ rotation
        # One Newton-Schulz step prevents accumulated rounding from skewing the rotation.
        rotation[:] = 0.5 * (turned @ (3.0 * np.eye(3) - turned.T @ turned))
    motion[0] += dt * motion[1]
    motion[2] = rotation @ (inverse @ (rotation.T @ momentum))


@kernel
def press(
    points: Any, up: Any, forward: Any, motion: Any, mass: Any, inverse: Any, static_load: Any,
    rest: Any, tyres: Any, rows: Any, heights: Any, dt: Any, impulse: Any,
) -> Any:  # fmt: skip
    """Apply road forces to four patches over ``dt`` [s]; updates the velocities in ``motion``.

    Springs and dampers act along the normal. In the tangent plane, friction stops the slip of each
    patch within its friction circle: laterally always, longitudinally in proportion to the braking.

    Args:
        points: [4, 3] patches, world frame [m].
        up, forward: [3] axes of the body.
        motion: see ``advance_on_wheels``.
        mass: [kg].
        inverse: [3, 3] inverse inertia, world axes.
        impulse: [3] the impulse of the road is added to it [N s].

    Returns:
        Energy dissipated by slip [J].
    """
    count = len(points)
    loads, normals, used = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 2))
    v, w = vector(motion[1]), vector(motion[2])
    before, before_spin, centre = v, w, vector(motion[0])
    for k in range(count):
        height, n = nearest_road(vector(points[k]), rows, heights)
        normals[k, 0], normals[k, 1], normals[k, 2] = n
        if dot(n, vector(up)) > UPRIGHT:
            speed = dot(n, velocity_at(v, w, minus(vector(points[k]), centre)))
            loads[k] = dt * spring_force(rest[k] - height, speed, static_load[k], tyres)
    total = (0.0, 0.0, 0.0)
    for k in range(count):
        given = scaled(loads[k], vector(normals[k]))
        v, w = pushed(v, w, given, minus(vector(points[k]), centre), mass, inverse)
        total = plus(total, given)
    friction_work = 0.0
    for _ in range(ROUNDS):
        for k in range(count):
            if loads[k] > 0.0:
                arm = minus(vector(points[k]), centre)
                given = grip(
                    v, w, arm, vector(normals[k]), vector(forward), loads[k], used[k], mass,
                    inverse, tyres,
                )  # fmt: skip
                v, w = pushed(v, w, given, arm, mass, inverse)
                total = plus(total, given)
                slip = plus(velocity_at(v, w, arm), velocity_at(before, before_spin, arm))
                friction_work -= 0.5 * dot(given, slip)
    for axis in range(3):
        motion[1, axis], motion[2, axis] = v[axis], w[axis]
        impulse[axis] += total[axis]
    return max(friction_work, 0.0)


@func
def nearest_road(point: Any, rows: Any, heights: Any) -> Any:
    """Height [m] of a point above the nearest collider, infinite without one; and its normal."""
    least, normal = math.inf, (0.0, 0.0, 1.0)
    for c in range(len(rows)):
        distance, n = collider_distance(rows[c], heights, point[0], point[1], point[2])
        if distance < least:
            least, normal = distance, n
    return least, normal


@func
def spring_force(squeeze: Any, speed: Any, static_load: Any, tyres: Any) -> Any:
    """Spring and damper force [N] of a wheel, by compression beyond rest [m] and its rate [m/s]."""
    omega = 2.0 * math.pi * tyres[FREQUENCY]
    carried = static_load / STATIC_GRAVITY
    if not squeeze > -STATIC_GRAVITY / (omega * omega):
        return 0.0
    force = static_load + carried * omega * omega * min(squeeze, 2.0 * tyres[TRAVEL])
    force -= 2.0 * tyres[DAMPING] * omega * carried * speed
    return max(force, 0.0)


@func
def grip(
    v: Any, w: Any, arm: Any, normal: Any, forward: Any, load: Any, used: Any, mass: Any,
    inverse: Any, tyres: Any,
) -> Any:  # fmt: skip
    """Additional tangential impulse (3) [N s] of a patch, within its friction circle."""
    along = minus(forward, scaled(dot(forward, normal), normal))
    along = scaled(1.0 / max(math.sqrt(dot(along, along)), 1e-9), along)
    side = cross(normal, along)
    slip = velocity_at(v, w, arm)
    held = max(tyres[BRAKE] * tyres[FRICTION], ROLLING) * load
    x = used[0] - dot(along, slip) / (1.0 / mass + bend(along, arm, inverse))
    y = used[1] - dot(side, slip) / (1.0 / mass + bend(side, arm, inverse))
    x = min(max(x, -held), held)
    fraction = min(1.0, tyres[FRICTION] * load / max(math.sqrt(x * x + y * y), 1e-12))
    x, y = fraction * x, fraction * y
    given = plus(scaled(x - used[0], along), scaled(y - used[1], side))
    used[0], used[1] = x, y
    return given


@func
def bend(axis: Any, arm: Any, inverse: Any) -> Any:
    """Speed change of a point along ``axis`` by rotation, per unit of impulse there."""
    return dot(axis, cross(times(inverse, cross(arm, axis)), arm))


@func
def pushed(v: Any, w: Any, impulse: Any, arm: Any, mass: Any, inverse: Any) -> Any:
    """Velocities after an impulse (3) [N s] at an arm (3) [m] from the centre of mass."""
    return plus(v, scaled(1.0 / mass, impulse)), plus(w, times(inverse, cross(arm, impulse)))


@func
def velocity_at(v: Any, w: Any, arm: Any) -> Any:
    """Velocity (3) [m/s] at an arm (3) [m] from the centre of mass."""
    return plus(v, cross(w, arm))


@func
def vector(row: Any) -> Any:
    """The three numbers of an array as a tuple."""
    return row[0], row[1], row[2]


@func
def dot(a: Any, b: Any) -> Any:
    """Scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@func
def cross(a: Any, b: Any) -> Any:
    """Cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@func
def plus(a: Any, b: Any) -> Any:
    """Sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@func
def minus(a: Any, b: Any) -> Any:
    """Difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@func
def scaled(factor: Any, a: Any) -> Any:
    """Product of a number and a vector."""
    return factor * a[0], factor * a[1], factor * a[2]


@func
def times(matrix: Any, a: Any) -> Any:
    """Product of a matrix [3, 3] and a vector."""
    return (
        matrix[0, 0] * a[0] + matrix[0, 1] * a[1] + matrix[0, 2] * a[2],
        matrix[1, 0] * a[0] + matrix[1, 1] * a[1] + matrix[1, 2] * a[2],
        matrix[2, 0] * a[0] + matrix[2, 1] * a[1] + matrix[2, 2] * a[2],
    )


ABOVE_MAX = 0.1
"""Maximum height of the tracked box of a standing vehicle above the road [m]."""
TRACK = 0.84
"""Track width as a fraction of the box width."""
LIFT_MAX = 0.3
"""Maximum displacement of wheels into their arches [m]."""


@dataclass(frozen=True, eq=False)
class TyreReaction:
    """The road's effect on a body through its tyres in one step.

    Attributes:
        impulse: [3] impulse on the body [N s].
        friction_work: energy dissipated by slip [J].
    """

    impulse: Float
    friction_work: float


@dataclass(frozen=True, eq=False)
class Tyres:
    """A vehicle's four wheels and the road below them.

    Attributes:
        patches: [4, 3] undersides of the wheels at rest, object frame [m].
        static_load: [4] load of each wheel at rest [N].
        friction: tyre-road friction coefficient.
        brake: fraction of the wheels' grip that resists rolling; 0 rolls freely, 1 is locked.
        frequency: natural frequency of the body on its springs [Hz].
        damping: damping ratio.
        travel: spring travel beyond rest before bottoming out [m].
        rest: [4] height of the undersides above the road at ``static_load`` [m].
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
        """Wheels under a box of ``size`` [m], with axles at 30 % of the length from the centre.

        Args:
            size: (length, width, height).
            centre: [3] centre of mass, object frame [m].
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
        """Tyres whose rest heights match the current pose, for wheels close to the road.

        Tracked boxes miss the road by a few centimetres, which must not cause a jump. Vehicles
        higher above the road fall.
        """
        heights, _ = nearest(road, self._points(T_world_object))
        near = (heights < ABOVE_MAX) & (heights > -LIFT_MAX)
        return replace(self, rest=np.where(near.all(), heights, np.zeros(4)))

    def braked(self, fraction: float) -> Tyres:
        """The tyres with a ``fraction`` of their grip braked, in [0, 1]."""
        return replace(self, brake=fraction)

    def lifts(self, T_world_object: Float, road: Sequence[Collider]) -> Float:
        """[4] spring compression that keeps the wheels from sinking into the road [m]."""
        heights, normals = nearest(road, self._points(T_world_object))
        carrying = np.isfinite(heights) & (normals @ T_world_object[:3, 2] > UPRIGHT)
        squeeze = np.where(carrying, self.rest - heights, 0.0)
        return np.clip(squeeze, 0.0, LIFT_MAX)

    def carrying(
        self, T_world_object: Float, road: Sequence[Collider]
    ) -> Iterator[tuple[Collider, Float, Float]]:
        """Supporting collider, contact point [3] [m] and normal [3] of each wheel on the ground."""
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
        """Maximum friction over load along a direction [3] on the road; reduced for rolling."""
        held = max(self.brake * self.friction, ROLLING)
        return min(self.friction, held / max(abs(float(direction @ forward)), 1e-9))

    def apply(
        self,
        motion: RigidMotion,
        T_world_object: Float,
        road: Sequence[Collider],
        duration: float,
    ) -> tuple[RigidMotion, TyreReaction]:
        """Apply the road's forces to the body through its tyres over ``duration`` [s].

        See :func:`press`.

        Returns:
            The motion after it, and the reaction of the road.
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
        """[5] tyre parameters for kernels."""
        return np.array([self.friction, self.brake, self.frequency, self.damping, self.travel])

    def _points(self, T_world_object: Float) -> Float:
        return self.patches @ T_world_object[:3, :3].T + T_world_object[:3, 3]


def track_of(size: Sequence[float]) -> float:
    """Distance between left and right wheels under a box of ``size`` [m]."""
    return TRACK * size[1]
