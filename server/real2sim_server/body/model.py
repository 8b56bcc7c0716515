"""The body model: a mesh with joints, skinning weights and a linear basis of shapes.

Its data, ``asset.npz``, come from MakeHuman (CC0); ``ASSET.md`` says how.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.transform import Float

_SIDED = ("clavicle", "upper_arm", "forearm", "hand", "thigh", "calf", "foot", "ball")

JOINTS = (
    *("pelvis", "spine_1", "spine_2", "spine_3", "neck", "head"),
    *(f"{name}_{side}" for side in "lr" for name in _SIDED),
)
"""Names of the joints, each after the one it hangs on."""

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
"""Joints that are the keypoints from the sixth on."""


@dataclass(frozen=True, eq=False)
class BodyModel:
    """What all bodies share.

    Attributes:
        vertices: [V, 3] mean shape in the rest pose, body frame [m].
        joints: [J, 3] joints of the mean shape [m].
        basis: [K, V + J, 3] change of vertices and joints by a shape coefficient of one, which is
            a standard deviation of the builds it was made of [m].
        builds: shape coefficients [K] of named builds.
        parents: [J] joint that each hangs on, -1 for the pelvis.
        weight_joints, weights: [V, 4] joints that move a vertex, and by how much; sums are one.
        triangles: [T, 3] vertices, anticlockwise seen from outside.
        triangle_groups: [T] index into ``group_names``.
        group_names: of the triangles that are always there ("body"), and of those that a person
            may have: "long_hair", "skirt".
        parts: [V] index into ``part_names``.
        part_names: of the parts of a body.
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
        """A body of a shape.

        Args:
            shape: [<= K] coefficients, or the name of a build (``builds``).
            height: of the body; scales it as a whole [m].

        Raises:
            ValueError: an unknown build, too many or unfit coefficients, a height outside
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
        """Indices of the triangles of the body and of further groups.

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
        model: that it is a shape of.
        shape: [<= K] coefficients.
        vertices: [V, 3], body frame [m].
        joints: [J, 3] [m].
        height: from the ground to the top of the head [m].
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
        """From the hip to the ground [m]."""
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
