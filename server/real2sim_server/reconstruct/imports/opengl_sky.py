"""Cube maps in the order and orientation of OpenGL (as nvdiffrast samples them) as a Sky."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...scene import Sky
from ...scene.scene import face_directions


def sky_from_opengl_cube(faces: Float, R_cube_world: Float) -> Sky:
    """The same sky in our face layout, clamped to [0, 1].

    Args:
        faces: [6, R, R, 3] RGB, faces +x -x +y -y +z -z of OpenGL.
        R_cube_world: [3, 3] rotation of world directions to those of the cube. Where it only
            exchanges axes, every pixel is moved and none is interpolated.
    """
    directions = face_directions(faces.shape[1]).astype(np.float64) @ R_cube_world.T
    face, row, column = _nearest_pixel(directions, faces.shape[1])
    moved = np.clip(faces[face, row, column], 0, 1).astype(np.float32)
    return Sky(torch.from_numpy(np.ascontiguousarray(moved)))


def _nearest_pixel(
    directions: Float, resolution: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Face, row and column [...] of an OpenGL cube map along ``directions`` [..., 3].

    OpenGL 4.6 specification, table 8.19: s to the right (columns), t down (rows).
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    axis = np.abs(directions).argmax(axis=-1)
    positive = np.take_along_axis(directions, axis[..., None], axis=-1)[..., 0] > 0
    face = 2 * axis + ~positive
    right = [-z, z, x, x, x, -x]
    down = [-y, -y, z, -z, -y, -y]
    major = np.abs(directions).max(axis=-1)
    column, row = (
        np.clip(
            np.rint((np.choose(face, of) / major + 1) / 2 * resolution - 0.5).astype(np.int64),
            0,
            resolution - 1,
        )
        for of in (right, down)
    )
    return face, row, column
