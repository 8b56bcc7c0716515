"""The body model: a mesh with joints, a linear shape basis, forward kinematics and skinning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numba import prange
from numpy.typing import ArrayLike, NDArray

from .._numba import kernel
from ..geometry import Float, quaternion_to_matrix

# The data in ``asset.npz`` are from MakeHuman (CC0); see ``ASSET.md``.

_SIDED = ("clavicle", "upper_arm", "forearm", "hand", "thigh", "calf", "foot", "ball")

JOINTS = (
    *("pelvis", "spine_1", "spine_2", "spine_3", "neck", "head"),
    *(f"{name}_{side}" for side in "lr" for name in _SIDED),
)
"""Names of the joints, each after its parent."""

KEYPOINTS = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
    *("left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"),
)
"""The 17 keypoints of COCO, in its order. Lin et al., "Microsoft COCO", 2014."""

KEYPOINT_JOINTS = tuple(
    JOINTS.index(f"{name}_{side}")
    for name in ("upper_arm", "forearm", "hand", "thigh", "calf", "foot")
    for side in "lr"
)
"""Joints used for the sixth and later keypoints."""


@dataclass(frozen=True, eq=False)
class BodyModel:
    """Data shared by all bodies.

    Attributes:
        vertices: [V, 3] mean shape in the rest pose, body frame [m].
        joints: [J, 3] joints of the mean shape [m].
        basis: [K, V + J, 3] change of vertices and joints per unit of a shape coefficient; one unit
            is a standard deviation of the source builds [m].
        builds: shape coefficients [K] of named builds.
        parents: [J] parent joint, -1 for the pelvis.
        weight_joints, weights: [V, 4] joints that move a vertex, and their weights, which sum to 1.
        triangles: [T, 3] vertices, counter-clockwise as seen from outside.
        triangle_groups: [T] index into ``group_names``.
        group_names: names of the triangles that are always present ("body") and of the optional
            ones ("long_hair", "skirt").
        parts: [V] index into ``part_names``.
        part_names: names of the body parts.
        mirror: [V] vertex on the other side.
        face: [5] vertices that are COCO's nose, eyes and ears.
    """

    vertices: Float
    joints: Float
    basis: Float
    builds: dict[str, Float]
    parents: NDArray[np.int64]
    weight_joints: NDArray[np.int64]
    weights: Float
    triangles: NDArray[np.int64]
    triangle_groups: NDArray[np.int64]
    group_names: tuple[str, ...]
    parts: NDArray[np.int64]
    part_names: tuple[str, ...]
    mirror: NDArray[np.int64]
    face: NDArray[np.int64]

    def shaped(self, shape: ArrayLike | str, *, height: float | None = None) -> Body:
        """A body with a shape.

        Args:
            shape: [<= K] coefficients, or the name of a build (``builds``).
            height: height of the body [m]; scales it uniformly.

        Raises:
            ValueError: an unknown build, too many or invalid coefficients, a height outside
                (0.4, 2.6).
        """
        coefficients = self._coefficients(shape)
        moved = np.tensordot(coefficients, self.basis[: len(coefficients)], axes=1)
        count = len(self.vertices)
        vertices, joints = self.vertices + moved[:count], self.joints + moved[count:]
        tall = float(vertices[:, 2].max())
        if height is not None:
            if not 0.4 < height < 2.6:
                raise ValueError(f"height must be between 0.4 and 2.6 m, not {height!r}")
            vertices, joints, tall = vertices * (height / tall), joints * (height / tall), height
        return Body(self, coefficients, vertices, joints, tall)

    def triangles_of(self, groups: Sequence[str]) -> NDArray[np.int64]:
        """Indices of the triangles of the body and of other groups.

        Raises:
            ValueError: an unknown group.
        """
        unknown = set(groups) - set(self.group_names)
        if unknown:
            raise ValueError(f"unknown groups {sorted(unknown)}; there are {self.group_names}")
        wanted = [self.group_names.index(name) for name in {"body", *groups}]
        return np.flatnonzero(np.isin(self.triangle_groups, wanted))

    def _coefficients(self, shape: ArrayLike | str) -> Float:
        if isinstance(shape, str):
            if shape not in self.builds:
                raise ValueError(f"unknown build {shape!r}; there are {', '.join(self.builds)}")
            return self.builds[shape]
        values = np.asarray(shape, dtype=np.float64)
        if values.ndim != 1 or len(values) > len(self.basis) or not np.isfinite(values).all():
            raise ValueError(
                f"shape must be a build's name or up to {len(self.basis)} finite coefficients"
            )
        return values


@dataclass(frozen=True, eq=False)
class Body:
    """A body in its rest pose.

    Attributes:
        model: the body model.
        shape: [<= K] coefficients.
        vertices: [V, 3], body frame [m].
        joints: [J, 3] [m].
        height: height from the ground to the top of the head [m].
    """

    model: BodyModel
    shape: Float
    vertices: Float
    joints: Float
    height: float

    def joint(self, name: str) -> Float:
        """Rest position [3] of a joint."""
        place: Float = self.joints[JOINTS.index(name)]
        return place

    @property
    def leg_length(self) -> float:
        """Height of the hip above the ground [m]."""
        return float(self.joint("thigh_l")[2])


@cache
def body_model() -> BodyModel:
    """The model that ships with the program."""
    with np.load(Path(__file__).with_name("asset.npz"), allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}
    basis = arrays["basis"] * arrays["basis_scale"].astype(np.float64)[:, None, None]
    builds = zip(arrays["build_names"].tolist(), arrays["builds"], strict=True)
    return BodyModel(
        vertices=arrays["vertices"].astype(np.float64),
        joints=arrays["joints"].astype(np.float64),
        basis=basis,
        builds={name: values.astype(np.float64) for name, values in builds},
        parents=arrays["parents"].astype(np.int64),
        weight_joints=arrays["weight_joints"].astype(np.int64),
        weights=arrays["weights"] / 255.0,
        triangles=arrays["triangles"].astype(np.int64),
        triangle_groups=arrays["triangle_groups"].astype(np.int64),
        group_names=tuple(arrays["group_names"].tolist()),
        parts=arrays["parts"].astype(np.int64),
        part_names=tuple(arrays["part_names"].tolist()),
        mirror=arrays["mirror"].astype(np.int64),
        face=arrays["keypoints"].astype(np.int64),
    )


# --- Skinning kernels -----------------------------------------------------------------------------

# A vertex maps to ``sum_k w_k (R_k x + t_k)``: Magnenat-Thalmann et al., "Joint-dependent local
# deformations for hand animation and object grasping", 1988.


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
        rotations: [..., J, 4] ``wxyz``, of each joint relative to its parent; the identity in the
            rest pose.
        pelvis: [..., 3] position of the pelvis joint, body frame [m].
    """

    rotations: Float
    pelvis: Float


def rest_pose(body: Body) -> Pose:
    """The pose of ``body.vertices``."""
    rotations = np.zeros((len(body.joints), 4))
    rotations[:, 0] = 1.0
    return Pose(rotations, body.joints[0].copy())


def joint_transforms(body: Body, pose: Pose) -> Float:
    """``[..., J, 3, 4]`` transforms of the joints from the rest pose to this pose."""
    return chain_transforms(body, quaternion_to_matrix(pose.rotations), pose.pelvis)


def chain_transforms(body: Body, rotations: Float, pelvis: Float) -> Float:
    """Like :func:`joint_transforms`, for rotation matrices [..., J, 3, 3]."""
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
    """Joints [..., J, 3] moved by transforms [..., J, 3, 4], body frame [m]."""
    turned: Float = (transforms[..., :3] @ body.joints[:, :, None])[..., 0]
    return turned + transforms[..., 3]


def skin(body: Body, transforms: Float) -> Float:
    """Vertices [..., V, 3] skinned by transforms [..., J, 3, 4], body frame [m]."""
    many = np.ascontiguousarray(transforms, dtype=np.float64).reshape(-1, len(body.joints), 3, 4)
    out: Float = skin_vertices(body.vertices, body.model.weight_joints, body.model.weights, many)
    return out.reshape(*transforms.shape[:-3], -1, 3)


def skin_reference(body: Body, transforms: Float) -> Float:
    """NumPy reference implementation of :func:`skin`."""
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
    """Unit normals [V, 3] of vertices [V, 3]: area-weighted means of their triangles' normals."""
    out: Float = mesh_normals(np.ascontiguousarray(vertices), triangles)
    return out


# --- Limbs ----------------------------------------------------------------------------------------

# Points and directions are [T, 3], rotations [T, 3, 3], for many instants at once.

UP = np.array([0.0, 0.0, 1.0])
LATERAL = np.array([0.0, 1.0, 0.0])


def unit(v: Float) -> Float:
    """Directions [..., 3] of vectors."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def about(axis: ArrayLike, angle: ArrayLike) -> Float:
    """Rotations [..., 3, 3] about a unit axis [3] by angles [...] (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.asarray(angle, dtype=np.float64)[..., None, None]
    turned: Float = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return turned


def aim(start: ArrayLike, end: Float) -> Float:
    """The shortest rotations [T, 3, 3] from directions [3] or [T, 3] to directions [T, 3]."""
    a, b = np.broadcast_arrays(unit(np.asarray(start, dtype=np.float64)), unit(end))
    v, c = np.cross(a, b), (a * b).sum(axis=-1)
    cross = np.zeros((*v.shape[:-1], 3, 3))
    cross[..., 0, 1], cross[..., 0, 2] = -v[..., 2], v[..., 1]
    cross[..., 1, 0], cross[..., 1, 2] = v[..., 2], -v[..., 0]
    cross[..., 2, 0], cross[..., 2, 1] = -v[..., 1], v[..., 0]
    scale = 1.0 / np.maximum(1.0 + c, 1e-6)
    turned: Float = np.eye(3) + cross + (cross @ cross) * scale[..., None, None]
    return turned


def frame(along: Float, lateral: Float) -> Float:
    """Right-handed frames [..., 3, 3] with columns: along, lateral orthogonalised, their normal."""
    along = unit(along)
    square = unit(lateral - (lateral * along).sum(axis=-1, keepdims=True) * along)
    return np.stack([along, square, np.cross(along, square)], axis=-1)


def partial_turn(rotations: Float, fraction: float) -> Float:
    """The rotations [T, 3, 3] with their angles scaled by a fraction, about the same axes."""
    trace = np.trace(rotations, axis1=-2, axis2=-1)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    skew = (rotations - np.swapaxes(rotations, -1, -2)) / 2
    axis = skew / np.maximum(np.sin(angle), 1e-9)[..., None, None]
    part = (angle * fraction)[..., None, None]
    turned: Float = np.eye(3) + np.sin(part) * axis + (1 - np.cos(part)) * (axis @ axis)
    return turned


def bend(start: Float, end: Float, upper: float, lower: float, towards: Float) -> Float:
    """Position of the middle joint [T, 3] of two bones.

    Args:
        start, end: [T, 3] ends of the limb; an end out of reach gives a straight limb.
        upper, lower: lengths of its bones [m].
        towards: [T, 3], direction of the middle joint.
    """
    line = end - start
    reach = np.clip(
        np.linalg.norm(line, axis=-1), abs(upper - lower) + 1e-6, (upper + lower) * (1 - 1e-9)
    )
    along = unit(line)
    aside = unit(towards - (towards * along).sum(axis=-1, keepdims=True) * along)
    ahead = (upper**2 - lower**2 + reach**2) / (2 * reach)
    off = np.sqrt(np.maximum(upper**2 - ahead**2, 0.0))
    return start + ahead[..., None] * along + off[..., None] * aside


def smooth(x: ArrayLike) -> Float:
    """From 0 to 1 over [0, 1], with zero slope at both ends."""
    x = np.clip(np.asarray(x, dtype=np.float64), 0.0, 1.0)
    return x * x * (3 - 2 * x)
