"""Meshes with known distances, for tests of colliders."""

from __future__ import annotations

import numpy as np

from real2sim_server.physics import TriangleSurface

BOX_FACES = (
    (0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
    (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5),
)  # fmt: skip


def box_corners(size) -> np.ndarray:
    """[8, 3], the last axis fastest: (-, -, -), (-, -, +), (-, +, -), ..."""
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    return signs * np.asarray(size)


def box_surface(size) -> TriangleSurface:
    return TriangleSurface(box_corners(size), np.array(BOX_FACES))


def half_pipe(radius: float, length: float, *, sides: int = 48, thickness=0.02) -> TriangleSurface:
    """A sheet around the y axis, open at the top, with the given inner radius."""
    angle = np.linspace(-np.pi, 0, sides + 1)
    outer = radius + thickness / 2
    ring = np.stack([outer * np.cos(angle), 0 * angle, outer * np.sin(angle)], axis=1)
    ends = [ring + np.array([0, y, 0]) for y in (-length / 2, length / 2)]
    k = np.arange(sides)
    n = sides + 1
    quads = np.stack([k, k + 1, k + 1 + n, k + n], axis=1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return TriangleSurface(np.concatenate(ends), triangles, thickness)
