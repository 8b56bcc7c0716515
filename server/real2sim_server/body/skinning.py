"""Forward kinematics and linear blend skinning.

A vertex goes to ``sum_k w_k (R_k x + t_k)``: Magnenat-Thalmann et al., "Joint-dependent local
deformations for hand animation and object grasping", 1988.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from .._numba import kernel
from ..geometry.transform import Float, quaternion_to_matrix
from .model import KEYPOINT_JOINTS, Body

# --- Kernels -------------------------------------------------------------------------------------


@kernel(parallel=True)
def skin_vertices(vertices, weight_joints, weights, transforms):
    """Vertices [N, V, 3] of poses [N, J, 3, 4]; see :func:`.skinning.skin`."""
    poses, count = len(transforms), len(vertices)
    out = np.empty((poses, count, 3))
    for i in prange(poses * count):
        pose, v = i // count, i % count
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        for axis in range(3):
            total = 0.0
            for k in range(weights.shape[1]):
                m = transforms[pose, weight_joints[v, k]]
                moved = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3]
                total += weights[v, k] * moved
            out[pose, v, axis] = total
    return out


@kernel
def mesh_normals(vertices, triangles):
    """See :func:`.skinning.vertex_normals`."""
    out = np.zeros_like(vertices)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ux, uy, uz = vertices[b] - vertices[a]
        vx, vy, vz = vertices[c] - vertices[a]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for corner in (a, b, c):
            out[corner, 0] += nx
            out[corner, 1] += ny
            out[corner, 2] += nz
    for i in range(len(out)):
        length = np.sqrt(out[i, 0] ** 2 + out[i, 1] ** 2 + out[i, 2] ** 2)
        out[i] /= max(length, 1e-12)
    return out


@dataclass(frozen=True, eq=False)
class Pose:
    """Poses of a body, one or many.

    Attributes:
        rotations: [..., J, 4] ``wxyz``, of each joint against the one it hangs on; the identity
            in the rest pose.
        pelvis: [..., 3] where the pelvis joint is, body frame [m].
    """

    rotations: Float
    pelvis: Float


def rest_pose(body: Body) -> Pose:
    """The pose of ``body.vertices``."""
    rotations = np.zeros((len(body.joints), 4))
    rotations[:, 0] = 1.0
    return Pose(rotations, body.joints[0].copy())


def joint_transforms(body: Body, pose: Pose) -> Float:
    """``[..., J, 3, 4]`` that take points of the rest pose to where each joint carries them."""
    return chain_transforms(body, quaternion_to_matrix(pose.rotations), pose.pelvis)


def chain_transforms(body: Body, rotations: Float, pelvis: Float) -> Float:
    """As :func:`joint_transforms`, of matrices [..., J, 3, 3]."""
    turned = np.empty_like(rotations)
    places = np.empty(rotations.shape[:-1])
    for joint, parent in enumerate(body.model.parents):
        if parent < 0:
            turned[..., joint, :, :], places[..., joint, :] = rotations[..., joint, :, :], pelvis
            continue
        above = turned[..., parent, :, :]
        turned[..., joint, :, :] = above @ rotations[..., joint, :, :]
        bone = body.joints[joint] - body.joints[parent]
        places[..., joint, :] = places[..., parent, :] + above @ bone
    shift = places - (turned @ body.joints[:, :, None])[..., 0]
    return np.concatenate([turned, shift[..., None]], axis=-1)


def joint_positions(body: Body, transforms: Float) -> Float:
    """Joints [..., J, 3] of transforms [..., J, 3, 4]."""
    turned: Float = (transforms[..., :3] @ body.joints[:, :, None])[..., 0]
    return turned + transforms[..., 3]


def skin(body: Body, transforms: Float) -> Float:
    """Vertices [..., V, 3] of transforms [..., J, 3, 4], body frame [m]."""
    many = np.ascontiguousarray(transforms, dtype=np.float64).reshape(-1, len(body.joints), 3, 4)
    out: Float = skin_vertices(body.vertices, body.model.weight_joints, body.model.weights, many)
    return out.reshape(*transforms.shape[:-3], -1, 3)


def skin_reference(body: Body, transforms: Float) -> Float:
    """The plain twin of :func:`skin`."""
    chosen = transforms[..., body.model.weight_joints, :, :]
    blended: Float = (chosen * body.model.weights[:, :, None, None]).sum(axis=-3)
    turned: Float = (blended[..., :3] @ body.vertices[:, :, None])[..., 0]
    return turned + blended[..., 3]


def keypoints(body: Body, vertices: Float, transforms: Float) -> Float:
    """COCO's 17 keypoints [..., 17, 3] of skinned vertices [..., V, 3] and their transforms."""
    face = vertices[..., body.model.face, :]
    joints = joint_positions(body, transforms)[..., list(KEYPOINT_JOINTS), :]
    return np.concatenate([face, joints], axis=-2)


def vertex_normals(vertices: Float, triangles: NDArray[np.int64]) -> Float:
    """Unit normals [V, 3] of vertices [V, 3], means of their triangles' by area."""
    out: Float = mesh_normals(np.ascontiguousarray(vertices), triangles)
    return out
