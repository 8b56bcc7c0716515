"""Triangle meshes with texture coordinates and materials, built from quads and lofts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float

UNIT_UV = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
PAINT_WIDTH = 8


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        corners: [T, 3, 3] [m].
        uv: [T, 3, 2], texture coordinates of the material.
        normals: [T, 3, 3], at the corners, unit.
        material: [T] int32, see :mod:`.materials`.
        paint: [T] int32, row of the paint table.
    """

    corners: Float
    uv: Float
    normals: Float
    material: NDArray[np.int32]
    paint: NDArray[np.int32]


@dataclass
class MeshBuilder:
    """Collects triangles; ``paints`` is shared by all meshes of a world."""

    paints: list[tuple[float, ...]]
    _parts: list[Mesh] = field(default_factory=list)
    _quads: list[tuple[object, object, int, int]] = field(default_factory=list)

    def mix(self, *values: float) -> int:
        """Add a row to the paint table: red, green, blue (linear), then values of the material."""
        self.paints.append((*values, *([0.0] * (PAINT_WIDTH - len(values)))))
        return len(self.paints) - 1

    def quad(self, corners: ArrayLike, material: int, paint: int, uv: ArrayLike = UNIT_UV) -> None:
        """A flat quad [4, 3] with texture coordinates [4, 2]."""
        self._quads.append((corners, uv, material, paint))

    def box(self, low: ArrayLike, high: ArrayLike, material: int, paint: int) -> None:
        """An axis-aligned box; texture coordinates in metres along its sides."""
        self.oriented_box(np.eye(3), np.zeros(3), low, high, material=material, paint=paint)

    def oriented_box(
        self,
        axes: Float,
        origin: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        *,
        material: int,
        paint: int,
    ) -> None:
        """A box between ``low`` and ``high`` [3] in the frame of ``axes`` (rows) at ``origin``."""
        bounds = np.array([low, high], dtype=np.float64)
        for axis in range(3):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            for side in range(2):
                local = np.zeros((4, 3))
                local[:, axis] = bounds[side, axis]
                local[:, i] = bounds[[0, 1, 1, 0], i]
                local[:, j] = bounds[[0, 0, 1, 1], j]
                # Vertical faces get (along, up), so that textures are upright.
                uv = local[:, [j, i]] if j != 2 else local[:, [i, j]]
                self.quad(np.asarray(origin) + local @ axes, material, paint, uv)

    def grid(self, points: Float, uv: Float, material: int, paint: int) -> None:
        """A smooth surface through points [H, W, 3] with texture coordinates [H, W, 2]."""
        along = np.gradient(points, axis=0)
        across = np.gradient(points, axis=1)
        normals = np.cross(along, across)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        corners = _grid_triangles(points)
        keep = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        self._add(
            corners,
            _grid_triangles(uv),
            _grid_triangles(normals),
            material,
            paint,
            keep=keep > 1e-9,
        )

    def tube(
        self,
        path: ArrayLike,
        radii: ArrayLike,
        material: int,
        paint: int,
        *,
        sides: int = 8,
    ) -> None:
        """A tube along ``path`` [n, 3] with radii [n]; texture coordinates in metres."""
        path, radii = np.asarray(path, dtype=np.float64), np.asarray(radii, dtype=np.float64)
        direction = np.gradient(path, axis=0)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        away = np.where(np.abs(direction[:, 2:]) > 0.9, [[1.0, 0, 0]], [[0.0, 0, 1]])
        first = np.cross(direction, away)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(direction, first)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = first[:, None] * np.cos(angle)[:, None] + second[:, None] * np.sin(angle)[:, None]
        length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        uv = np.stack(
            np.broadcast_arrays(angle[None] * radii.mean(), length[:, None]), axis=-1
        ).astype(np.float64)
        corners = _grid_triangles(path[:, None] + ring * radii[:, None, None])
        self._add(corners, _grid_triangles(uv), _grid_triangles(ring), material, paint)

    def triangles(
        self, corners: Float, normals: Float, material: int, paint: int, uv: Float | None = None
    ) -> None:
        """Triangles [T, 3, 3] with corner normals [T, 3, 3]."""
        self._add(
            corners,
            np.zeros((*corners.shape[:2], 2)) if uv is None else uv,
            normals,
            material,
            paint,
        )

    def build(self) -> Mesh:
        """All triangles so far."""
        parts = [*self._parts, *([self._quad_mesh()] if self._quads else [])]
        return Mesh(
            np.concatenate([p.corners for p in parts]),
            np.concatenate([p.uv for p in parts]),
            np.concatenate([p.normals for p in parts]),
            np.concatenate([p.material for p in parts]),
            np.concatenate([p.paint for p in parts]),
        )

    def _add(
        self,
        corners: Float,
        uv: Float,
        normals: Float,
        material: int,
        paint: int,
        *,
        keep: NDArray[np.bool_] | None = None,
    ) -> None:
        if keep is not None:
            corners, uv, normals = corners[keep], uv[keep], normals[keep]
        n = len(corners)
        self._parts.append(
            Mesh(corners, uv, normals, np.full(n, material, np.int32), np.full(n, paint, np.int32))
        )

    def _quad_mesh(self) -> Mesh:
        corners = np.array([q[0] for q in self._quads], dtype=np.float64)
        uv = np.array([q[1] for q in self._quads], dtype=np.float64)
        order = [[0, 1, 2], [0, 2, 3]]
        corners = corners[:, order].reshape(-1, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return Mesh(
            corners,
            uv[:, order].reshape(-1, 3, 2),
            np.repeat(normals[:, None], 3, axis=1),
            np.repeat(np.array([q[2] for q in self._quads], np.int32), 2),
            np.repeat(np.array([q[3] for q in self._quads], np.int32), 2),
        )


def _grid_triangles(values: Float) -> Float:
    """[2 (H-1) (W-1), 3, C] corner values of the triangles of a grid [H, W, C]."""
    a, b, c, d = values[:-1, :-1], values[1:, :-1], values[1:, 1:], values[:-1, 1:]
    both = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2)
    return np.ascontiguousarray(both.reshape(-1, 3, values.shape[-1]))
