"""Things that do not yield: ground planes, height fields, and solids at rest or in motion.

A solid is closed: a box, a cylinder, a capsule, or a ``triangle_mesh``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.rotation import Float
from ..geometry.transform import is_rigid
from .errors import ColliderError


@dataclass(frozen=True, eq=False, kw_only=True)
class Collider:
    """What all colliders have in common.

    Attributes:
        name: unique among the colliders of a solver.
        friction: Coulomb coefficient, >= 0; None takes the body's; infinity sticks.
        separable: whether bodies may lift off; False holds whatever has touched.

    Raises:
        ColliderError: for values that make no sense.
    """

    name: str
    friction: float | None = None
    separable: bool = True

    def __post_init__(self) -> None:
        if self.friction is not None and not self.friction >= 0:
            raise ColliderError(
                f"friction of collider {self.name!r} must not be negative: {self.friction!r}"
            )
        self._check()

    def _check(self) -> None:
        """Check what a subclass adds."""

    @property
    def moving(self) -> bool:
        """Whether its pose changes with time."""
        return False

    @property
    def fastest_point(self) -> float:
        """Speed [m/s] that no point of it exceeds."""
        return 0.0

    def after(self, duration: float) -> Collider:
        """The collider ``duration`` [s] later."""
        return self


@dataclass(frozen=True, eq=False, kw_only=True)
class Plane(Collider):
    """A half-space; bodies stay on the side the normal points to.

    Attributes:
        point: [3] on the plane [m].
        normal: [3], any length.
    """

    point: ArrayLike = (0.0, 0.0, 0.0)
    normal: ArrayLike = (0.0, 0.0, 1.0)

    def _check(self) -> None:
        object.__setattr__(self, "point", _vector(self, "point"))
        normal = _vector(self, "normal")
        length = float(np.linalg.norm(normal))
        if length < 1e-12:
            raise ColliderError(f"normal of plane {self.name!r} must have a length: {normal!r}")
        object.__setattr__(self, "normal", normal / length)


@dataclass(frozen=True, eq=False, kw_only=True)
class Solid(Collider):
    """What has an inside, at rest or moving as a rigid body. Its pose is the field POSE names.

    Attributes:
        velocity: [3] of the origin of its frame [m/s].
        angular_velocity: [3] about that origin, world axes [rad/s].
    """

    POSE: ClassVar[str]

    velocity: ArrayLike = (0.0, 0.0, 0.0)
    angular_velocity: ArrayLike = (0.0, 0.0, 0.0)

    def _check(self) -> None:
        pose = np.array(getattr(self, self.POSE), dtype=np.float64)
        if not is_rigid(pose):
            raise ColliderError(f"{self.POSE} of {self.name!r} must be rigid [4, 4]: {pose!r}")
        object.__setattr__(self, self.POSE, pose)
        for name in ("velocity", "angular_velocity"):
            object.__setattr__(self, name, _vector(self, name))

    @property
    def pose(self) -> Float:
        """[4, 4] its frame to the world."""
        pose: Float = getattr(self, self.POSE)
        return pose

    @property
    def bounds(self) -> tuple[Float, Float]:
        """Lowest and highest corner [3] of the box about it in its own frame [m]."""
        raise NotImplementedError

    @property
    def thickness(self) -> float:
        """Least extent across it [m]."""
        low, high = self.bounds
        return float((high - low).min())

    @cached_property
    def moving(self) -> bool:
        """Whether it has any velocity."""
        return bool(np.any(self.velocity) or np.any(self.angular_velocity))

    @cached_property
    def fastest_point(self) -> float:
        """Speed [m/s] that no point of it exceeds."""
        low, high = self.bounds
        reach = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
        spin = float(np.linalg.norm(self.angular_velocity))
        return float(np.linalg.norm(self.velocity)) + reach * spin

    def velocity_at(self, point: Float) -> Float:
        """Velocity [3] of its material at a point [3] of the world [m/s]."""
        turning = np.cross(np.asarray(self.angular_velocity), point - self.pose[:3, 3])
        velocity: Float = np.asarray(self.velocity) + turning
        return velocity

    def at_rest(self) -> Self:
        """The same, where it is, standing still."""
        return replace(self, velocity=np.zeros(3), angular_velocity=np.zeros(3))

    def after(self, duration: float) -> Self:
        """The solid ``duration`` [s] later, moved at its velocities."""
        if not self.moving:
            return self
        pose = np.array(self.pose)
        pose[:3, 3] += duration * np.asarray(self.velocity)
        pose[:3, :3] = _rotation(np.asarray(self.angular_velocity) * duration) @ pose[:3, :3]
        moved: dict[str, Any] = {self.POSE: pose}
        return replace(self, **moved)


@dataclass(frozen=True, eq=False, kw_only=True)
class Box(Solid):
    """A solid oriented box, at rest or moving as a rigid body.

    Attributes:
        T_world_box: [4, 4] pose; origin at the centre of the box.
        size: [3] edge lengths [m].
        velocity: [3] of its centre [m/s].
        angular_velocity: [3] about its centre, world axes [rad/s].
    """

    POSE: ClassVar[str] = "T_world_box"

    T_world_box: ArrayLike
    size: ArrayLike

    def _check(self) -> None:
        super()._check()
        object.__setattr__(self, "size", _vector(self, "size"))
        if (np.asarray(self.size) <= 0).any():
            raise ColliderError(f"size of box {self.name!r} must be positive: {self.size!r}")

    @property
    def bounds(self) -> tuple[Float, Float]:  # noqa: D102
        half = np.asarray(self.size) / 2
        return -half, half


@dataclass(frozen=True, eq=False, kw_only=True)
class Cylinder(Solid):
    """A solid round post or drum with flat ends, about the z axis of its frame.

    Attributes:
        T_world_cylinder: [4, 4] pose; origin at the centre.
        radius: [m], > 0.
        height: along its axis [m], > 0.
    """

    POSE: ClassVar[str] = "T_world_cylinder"

    T_world_cylinder: ArrayLike
    radius: float
    height: float

    def _check(self) -> None:
        super()._check()
        _require_length(self, "radius")
        _require_length(self, "height")

    @property
    def bounds(self) -> tuple[Float, Float]:  # noqa: D102
        half = np.array([self.radius, self.radius, self.height / 2])
        return -half, half


@dataclass(frozen=True, eq=False, kw_only=True)
class Capsule(Solid):
    """All that is within ``radius`` of a line along the z axis of its frame; a ball for length 0.

    Attributes:
        T_world_capsule: [4, 4] pose; origin at the middle of the line.
        radius: [m], > 0.
        length: of the line, without the round ends [m], >= 0.
    """

    POSE: ClassVar[str] = "T_world_capsule"

    T_world_capsule: ArrayLike
    radius: float
    length: float

    def _check(self) -> None:
        super()._check()
        _require_length(self, "radius")
        if self.length != 0:
            _require_length(self, "length")

    @property
    def bounds(self) -> tuple[Float, Float]:  # noqa: D102
        half = np.array([self.radius, self.radius, self.length / 2 + self.radius])
        return -half, half


@dataclass(frozen=True, eq=False, kw_only=True)
class HeightField(Collider):
    """Ground given by heights on a regular grid; particles below it are pushed up.

    Outside the grid the nearest rim height holds.

    Attributes:
        heights: [X, Y] float64 [m], X and Y >= 2.
        origin: [2] (x, y) of ``heights[0, 0]`` [m].
        spacing: distance of samples [m], > 0.
    """

    heights: NDArray[np.float64]
    origin: ArrayLike = (0.0, 0.0)
    spacing: float = 1.0

    def _check(self) -> None:
        heights = np.ascontiguousarray(self.heights, dtype=np.float64)
        if heights.ndim != 2 or min(heights.shape) < 2 or not np.isfinite(heights).all():
            raise ColliderError(
                f"heights of {self.name!r} must be finite [X, Y] with X, Y >= 2: {heights.shape}"
            )
        if not (math.isfinite(self.spacing) and self.spacing > 0):
            raise ColliderError(f"spacing of {self.name!r} must be positive: {self.spacing!r}")
        object.__setattr__(self, "heights", heights)
        object.__setattr__(self, "origin", _vector(self, "origin", 2))


def _vector(collider: Collider, name: str, length: int = 3) -> Float:
    value = np.array(getattr(collider, name), dtype=np.float64)
    if value.shape != (length,) or not np.isfinite(value).all():
        raise ColliderError(f"{name} of {collider.name!r} must be {length} numbers, not {value!r}")
    return value


def _require_length(collider: Collider, name: str) -> None:
    value = getattr(collider, name)
    if not (math.isfinite(value) and value > 0):
        kind = type(collider).__name__.lower()
        raise ColliderError(f"{name} of {kind} {collider.name!r} must be positive [m]: {value!r}")


def _rotation(rotation_vector: Float) -> Float:
    """Rotation matrix [3, 3] of a rotation vector [3] [rad] (Rodrigues)."""
    angle = float(np.linalg.norm(rotation_vector))
    if angle < 1e-300:
        return np.eye(3)
    x, y, z = rotation_vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Float = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k)
    return rotation
