"""Rigid obstacles: ground planes, height fields, and solids at rest or in motion.

A solid is closed: a box, a cylinder, a capsule, or triangles. Triangles form a closed body or a
sheet of a given thickness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float, is_rigid
from .contact import MESH_NODE
from .errors import ColliderError


@dataclass(frozen=True, eq=False, kw_only=True)
class Collider:
    """Base class of colliders.

    Attributes:
        name: unique name in a solver.
        friction: Coulomb coefficient, >= 0; None uses the body's; infinity sticks.
        separable: whether bodies may lift off; if False, contacts are permanent.

    Raises:
        ColliderError: for invalid values.
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
        """Validate the fields of a subclass."""

    @property
    def moving(self) -> bool:
        """Whether its pose changes with time."""
        return False

    @property
    def fastest_point(self) -> float:
        """Upper bound of the speed of its points [m/s]."""
        return 0.0

    def after(self, duration: float) -> Collider:
        """The collider ``duration`` [s] later."""
        return self


@dataclass(frozen=True, eq=False, kw_only=True)
class Plane(Collider):
    """A half-space; bodies stay on the side of the normal.

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
    """A closed shape, at rest or in rigid motion. The field named POSE is its pose.

    Attributes:
        velocity: [3] velocity of the origin of its frame [m/s].
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
        """[4, 4] transform from its frame to the world."""
        pose: Float = getattr(self, self.POSE)
        return pose

    @property
    def bounds(self) -> tuple[Float, Float]:
        """Lowest and highest corner [3] of its bounding box, own frame [m]."""
        raise NotImplementedError

    @property
    def thickness(self) -> float:
        """Smallest extent [m]."""
        low, high = self.bounds
        return float((high - low).min())

    @cached_property
    def moving(self) -> bool:
        """Whether it has any velocity."""
        return bool(np.any(self.velocity) or np.any(self.angular_velocity))

    @cached_property
    def fastest_point(self) -> float:
        """Upper bound of the speed of its points [m/s]."""
        low, high = self.bounds
        reach = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
        spin = float(np.linalg.norm(self.angular_velocity))
        return float(np.linalg.norm(self.velocity)) + reach * spin

    def velocity_at(self, point: Float) -> Float:
        """Velocity [3] of its material at a world point [3] [m/s]."""
        turning = np.cross(np.asarray(self.angular_velocity), point - self.pose[:3, 3])
        velocity: Float = np.asarray(self.velocity) + turning
        return velocity

    def at_rest(self) -> Self:
        """The solid at its current pose, at rest."""
        return replace(self, velocity=np.zeros(3), angular_velocity=np.zeros(3))

    def after(self, duration: float) -> Self:
        """The solid moved at its velocities for ``duration`` [s]."""
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
    """A solid cylinder along the z axis of its frame.

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
    """All points within ``radius`` of a line along its z axis; a ball for length 0.

    Attributes:
        T_world_capsule: [4, 4] pose; origin at the middle of the line.
        radius: [m], > 0.
        length: length of the line, without the round ends [m], >= 0.
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
    """Ground as heights on a regular grid; particles below it are pushed up.

    Outside the grid the nearest border height applies.

    Attributes:
        heights: [X, Y] float64 [m], X and Y >= 2.
        origin: [2] (x, y) of ``heights[0, 0]`` [m].
        spacing: sample spacing [m], > 0.
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


# Colliders made of triangles.
#
# The sign of a distance comes from the pseudonormal of the nearest face, edge or vertex (Baerentzen
# and Aanaes 2005), which is exact for closed meshes. Queries use a bounding volume tree in one
# array and skip boxes that are too far away.

TRIANGLES_MAX = 20_000
FLAT = 1e-10
"""Minimum height of a triangle relative to the mesh; flatter ones are degenerate."""
_SIDES = ((0, 1), (1, 2), (2, 0))
"""Edges of a triangle, in the order of their pseudonormals."""


@dataclass(frozen=True, eq=False)
class TriangleSurface:
    """Validated triangles with a search tree; may be shared by many colliders.

    Attributes:
        vertices: [V, 3] [m]; duplicates are merged.
        triangles: [T, 3] vertex indices, counter-clockwise seen from outside. A closed mesh with
            inverted orientation is flipped.
        thickness: thickness of an open sheet [m]; None for a closed mesh.
        packed: kernel form, see ``contact.collider_distance``.
        corners: [T, 3, 3] corners of the triangles [m].
        normals: [T, 7, 3] pseudonormals: face, edges 01, 12, 20, corners.

    Raises:
        ColliderError: with the first invalid triangle or the number of invalid edges.
    """

    vertices: ArrayLike
    triangles: ArrayLike
    thickness: float | None = None
    packed: Float = field(init=False)
    corners: Float = field(init=False)
    normals: Float = field(init=False)

    def __post_init__(self) -> None:
        vertices, triangles = _checked(self.vertices, self.triangles)
        if self.thickness is not None and not (np.isfinite(self.thickness) and self.thickness > 0):
            raise ColliderError(
                f"thickness of a mesh must be positive [m], not {self.thickness!r}; leave it out "
                "for a mesh that is closed"
            )
        if self.thickness is None:
            triangles = _closed(vertices, triangles)
        corners = vertices[triangles]
        normals = _pseudonormals(vertices, triangles)
        values = {
            "vertices": vertices,
            "triangles": triangles,
            "corners": corners,
            "normals": normals,
            "packed": np.concatenate(
                [_tree(corners), np.concatenate([corners, normals], axis=1).ravel()]
            ),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def nodes(self) -> int:
        """Number of nodes of the tree."""
        return 2 * len(self.corners) - 1

    @property
    def bounds(self) -> tuple[Float, Float]:
        """Lowest and highest corner [3] of its bounding box [m]."""
        around = 0.0 if self.thickness is None else self.thickness / 2
        points = self.corners.reshape(-1, 3)
        return points.min(axis=0) - around, points.max(axis=0) + around


@dataclass(frozen=True, eq=False, kw_only=True)
class TriangleMesh(Solid):
    """A solid of triangles, or a sheet with a thickness, at rest or moving as a rigid body.

    Attributes:
        T_world_mesh: [4, 4] pose.
        surface: triangles, mesh frame.
    """

    POSE: ClassVar[str] = "T_world_mesh"

    T_world_mesh: ArrayLike
    surface: TriangleSurface

    @property
    def bounds(self) -> tuple[Float, Float]:  # noqa: D102
        return self.surface.bounds

    @property
    def thickness(self) -> float:
        """0, because the thickness of its parts is unknown."""
        return 0.0


def _checked(given: ArrayLike, faces: ArrayLike) -> tuple[Float, NDArray[np.int64]]:
    vertices = np.array(given, dtype=np.float64)
    triangles = np.array(faces)
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or not np.isfinite(vertices).all():
        raise ColliderError(f"vertices of a mesh must be finite [V, 3], not {vertices.shape}")
    if triangles.ndim != 2 or triangles.shape[1:] != (3,) or triangles.dtype.kind not in "iu":
        raise ColliderError(
            f"triangles of a mesh must be whole numbers [T, 3], not {triangles.shape}"
        )
    if not 0 < len(triangles) <= TRIANGLES_MAX:
        raise ColliderError(
            f"a mesh has 1 to {TRIANGLES_MAX} triangles, not {len(triangles)}; cut it up, or take "
            "a coarser one"
        )
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ColliderError(
            f"triangles of a mesh name vertices {triangles.min()} to {triangles.max()}; there are "
            f"0 to {len(vertices) - 1}"
        )
    vertices, same = np.unique(vertices, axis=0, return_inverse=True)
    triangles = same.reshape(-1)[triangles.astype(np.int64)]
    _require_area(vertices[triangles])
    return vertices, triangles


def _require_area(corners: Float) -> None:
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    doubled = np.linalg.norm(_areas(corners), axis=1)
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    flat = np.flatnonzero(doubled <= FLAT * max(extent, 1e-30) * sides)
    if len(flat):
        raise ColliderError(
            f"triangle {flat[0]} of a mesh has no area (and {len(flat) - 1} more): its corners are "
            f"{corners[flat[0]].tolist()}; leave it out"
        )


def _areas(corners: Float) -> Float:
    """[T, 3] normals of triangles, with a length of twice their area."""
    doubled: Float = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return doubled


def _closed(vertices: Float, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """The triangles of a closed mesh, facing outwards."""
    edges = np.concatenate([triangles[:, list(side)] for side in _SIDES])
    _, index, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True,
                               return_counts=True)  # fmt: skip
    index = index.reshape(-1)
    odd = uses != 2
    if odd.any():
        a, b = edges[np.flatnonzero(odd[index])[0]]
        what = "open" if (uses < 2).any() else "not the surface of a body"
        raise ColliderError(
            f"the mesh is {what}: {int(odd.sum())} edges do not belong to two triangles, the first "
            f"from {vertices[a].tolist()} to {vertices[b].tolist()}; close it, or give the "
            "thickness of a sheet"
        )
    # Consistently oriented neighbours traverse their common edge in opposite directions.
    forwards = np.bincount(index, weights=edges[:, 0] < edges[:, 1], minlength=len(uses))
    if (forwards != 1).any():
        raise ColliderError(
            f"triangles of the mesh do not all face outwards: at {int((forwards != 1).sum())} "
            "edges one lists its vertices clockwise and its neighbour counter-clockwise"
        )
    corners = vertices[triangles]
    volume = float(np.einsum("ti,ti->", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]))
    return triangles if volume > 0 else triangles[:, ::-1]


def _pseudonormals(vertices: Float, triangles: NDArray[np.int64]) -> Float:
    """[T, 7, 3] see :class:`TriangleSurface`; those of corners are weighted by angle."""
    corners = vertices[triangles]
    faces = _unit(_areas(corners))
    normals = np.empty((len(triangles), 7, 3))
    normals[:, 0] = faces
    edges = np.sort(np.concatenate([triangles[:, list(side)] for side in _SIDES]), axis=1)
    _, index = np.unique(edges, axis=0, return_inverse=True)
    index = index.reshape(-1)
    at_edges = np.zeros((index.max() + 1, 3))
    np.add.at(at_edges, index, np.tile(faces, (3, 1)))
    at_vertices = np.zeros_like(vertices)
    for k in range(3):
        ahead = _unit(corners[:, (k + 1) % 3] - corners[:, k])
        behind = _unit(corners[:, (k + 2) % 3] - corners[:, k])
        angle = np.arccos(np.clip((ahead * behind).sum(axis=1), -1, 1))
        np.add.at(at_vertices, triangles[:, k], angle[:, None] * faces)
    normals[:, 1:4] = at_edges[index].reshape(3, -1, 3).transpose(1, 0, 2)
    normals[:, 4:] = at_vertices[triangles]
    # The normals of two faces of a folded sheet may cancel.
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    return np.where(lengths > 1e-9, normals / np.maximum(lengths, 1e-9), faces[:, None])


def _unit(vectors: Float) -> Float:
    unit: Float = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
    return unit


def _tree(corners: Float) -> Float:
    """Bounding volume tree, split along the longest edge down to one triangle per leaf.

    Each row is low (3), high (3), the next row after its subtree, and its triangle or -1.
    """
    low, high = corners.min(axis=1), corners.max(axis=1)
    centres = (low + high) / 2
    nodes = np.empty((2 * len(corners) - 1, MESH_NODE))
    waiting = [(0, np.arange(len(corners)))]
    while waiting:
        at, own = waiting.pop()
        nodes[at, :3], nodes[at, 3:6] = low[own].min(axis=0), high[own].max(axis=0)
        nodes[at, 6] = at + 2 * len(own) - 1
        nodes[at, 7] = own[0] if len(own) == 1 else -1
        if len(own) > 1:
            axis = int(np.ptp(centres[own], axis=0).argmax())
            own = own[np.argsort(centres[own, axis], kind="stable")]
            half = len(own) // 2
            waiting += [(at + 1, own[:half]), (at + 2 * half, own[half:])]
    return nodes.ravel()
