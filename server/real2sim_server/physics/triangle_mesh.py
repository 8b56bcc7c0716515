"""Colliders made of triangles: walls and kerbs as they are, closed bodies or sheets of a thickness.

The sign of a distance comes from pseudonormals of the nearest face, edge or vertex (Baerentzen and
Aanaes 2005), which is exact for closed meshes. Triangles are found by a tree of boxes that is one
array: of a box that is too far away a query skips all that is within.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.rotation import Float
from .colliders import Solid
from .contact.collider_distance import MESH_NODE
from .errors import ColliderError

TRIANGLES_MAX = 20_000
FLAT = 1e-10
"""Triangles whose height is below this fraction of the mesh are degenerate."""
_SIDES = ((0, 1), (1, 2), (2, 0))
"""Edges of a triangle, in the order of their pseudonormals."""


@dataclass(frozen=True, eq=False)
class TriangleSurface:
    """Triangles that are checked and ready for queries; may be shared by many colliders.

    Attributes:
        vertices: [V, 3] [m]; those at the same place become one.
        triangles: [T, 3] indices of vertices, counter-clockwise seen from outside. A closed mesh
            that is inside out as a whole is turned.
        thickness: of a sheet that is not closed [m]; None for a closed mesh.
        packed: as kernels read it, see ``contact.collider_distance``.
        corners: [T, 3, 3] of the triangles [m].
        normals: [T, 7, 3] pseudonormals: face, edges 01, 12, 20, corners.

    Raises:
        ColliderError: with the first triangle or the number of edges that are not as they must be.
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
        """Of the tree of boxes."""
        return 2 * len(self.corners) - 1

    @property
    def bounds(self) -> tuple[Float, Float]:
        """Lowest and highest corner [3] of the box about it [m]."""
        around = 0.0 if self.thickness is None else self.thickness / 2
        points = self.corners.reshape(-1, 3)
        return points.min(axis=0) - around, points.max(axis=0) + around


@dataclass(frozen=True, eq=False, kw_only=True)
class TriangleMesh(Solid):
    """A solid of triangles, or a sheet with a thickness, at rest or moving as a rigid body.

    Attributes:
        T_world_mesh: [4, 4] pose.
        surface: in the mesh's own frame.
    """

    POSE: ClassVar[str] = "T_world_mesh"

    T_world_mesh: ArrayLike
    surface: TriangleSurface

    @property
    def bounds(self) -> tuple[Float, Float]:  # noqa: D102
        return self.surface.bounds

    @property
    def thickness(self) -> float:
        """0: how thin parts of it are is not known."""
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
    """[T, 3] normals of triangles as long as twice their area."""
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
    # Of two triangles that face the same way one runs along their edge forwards, one backwards.
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
    # Two faces of a folded sheet may cancel each other.
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    return np.where(lengths > 1e-9, normals / np.maximum(lengths, 1e-9), faces[:, None])


def _unit(vectors: Float) -> Float:
    unit: Float = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
    return unit


def _tree(corners: Float) -> Float:
    """Boxes about triangles, halved along their longest edge down to one triangle each.

    Each is low (3), high (3), the box that follows all that is within it, and its triangle or -1.
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
