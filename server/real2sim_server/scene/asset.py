"""Assets: objects that can be inserted into any scene, and people built from the body model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..body import JOINTS, Body, body_model, joint_transforms, skin
from ..body.gait import GaitStyle, plan_gait
from ..geometry import Float, matrix_to_quaternion
from .cloud import SH_C0, GaussianCloud
from .errors import SceneError
from .figure import Figure
from .scene import box_size


@dataclass(frozen=True, eq=False)
class Asset:
    """A cluster of Gaussians with a box that can be inserted into any scene. Immutable.

    Attributes:
        asset_id: unique within an asset library.
        category: class of the object, for example ``car``.
        size: (length, width, height) along the asset's x, y, z [m].
        cloud: Gaussians in the object frame: origin at the box centre, x forward, z up.
        provenance: origin of the asset (JSON values only).
        content_hash: SHA-256 of the bundle on disk; empty if not saved.
        figure: figure of a walking person, with ``cloud`` in the rest pose; or None.

    Raises:
        SceneError: ``size`` is not three positive lengths, or the figure belongs to another cloud.
    """

    asset_id: str
    category: str
    size: tuple[float, float, float]
    cloud: GaussianCloud
    provenance: Mapping[str, Any] = field(default_factory=dict)
    content_hash: str = ""
    figure: Figure | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", box_size(self.size, f"asset {self.asset_id!r}"))
        if self.figure is not None:
            self.figure.check_cloud(self.cloud, f"asset {self.asset_id!r}")
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))

    @property
    def nbytes(self) -> int:
        """Memory of the Gaussians [bytes]."""
        return self.cloud.nbytes + (self.figure.nbytes if self.figure else 0)

    def to(self, device: torch.device | str) -> Asset:
        """The asset on another device."""
        return replace(self, cloud=self.cloud.to(device))


# People: Gaussians on the surface of the body model, bound to its joints.

GAUSSIANS = 4000
CLOTHES: dict[str, tuple[float, float, float]] = {
    "skin": (0.72, 0.54, 0.43),
    "hair": (0.16, 0.11, 0.08),
    "top": (0.2, 0.33, 0.6),
    "trousers": (0.16, 0.17, 0.22),
    "shoes": (0.1, 0.1, 0.1),
}
"""Pieces of clothing and their default colours, RGB in [0, 1]."""

WORN = ("long_hair", "skirt")
"""Optional garments."""
OPACITY = 0.97
THICKNESS = 0.004
"""Standard deviation along the normal [m]."""
STROLL = 1.4
"""Walking speed that determines the size of the box [m/s]."""

_WEARS = {
    "head": "skin", "hand": "skin", "hair": "hair", "torso": "top", "upper": "top",
    "forearm": "top", "skirt": "top", "hips": "trousers", "thigh": "trousers", "calf": "trousers",
    "foot": "shoes",
}  # fmt: skip
EYES = (0.03, 0.02, 0.02)


def person_asset(
    asset_id: str,
    build: str,
    *,
    height: float | None = None,
    clothes: Mapping[str, tuple[float, float, float]] | None = None,
    worn: Sequence[str] = (),
    gaussians: int = GAUSSIANS,
    style: GaitStyle | None = None,
) -> Asset:
    """A person who can walk along any trajectory.

    Args:
        asset_id: name of the asset.
        build: a build of the body model, for example ``woman`` or ``boy``.
        height: height of the person [m]; by default that of the build.
        clothes: colours that differ from ``CLOTHES``.
        worn: garments from ``WORN``.
        gaussians: number of Gaussians.
        style: walking style.

    Raises:
        SceneError: an unknown build, garment or piece of clothing, a height outside (0.4, 2.6), or
            a colour outside [0, 1].
    """
    colours = CLOTHES | _checked(clothes or {})
    try:
        body = body_model().shaped(build, height=height)
        triangles = body.model.triangles[body.model.triangles_of(worn)]
    except ValueError as error:
        raise SceneError(f"person: {error}") from error
    low, high = _extent(body)
    middle = float(low[2] + high[2]) / 2
    chosen, shares = _samples(body, triangles, gaussians)
    joints, weights = _bindings(body, chosen, shares)
    figure = Figure(
        tuple(body.shape), body.height, middle,
        torch.from_numpy(joints), torch.from_numpy(weights), style or GaitStyle(),
    )  # fmt: skip
    reach = 2 * np.maximum(-low, high)
    return Asset(
        asset_id,
        "pedestrian",
        (float(reach[0]), float(reach[1]), float(high[2] - low[2])),
        _cloud(body, triangles, chosen, shares, colours, middle),
        {"source": "body model", "build": build, "height": body.height},
        figure=figure,
    )


def _checked(
    clothes: Mapping[str, tuple[float, float, float]],
) -> dict[str, tuple[float, float, float]]:
    for name, colour in clothes.items():
        if name not in CLOTHES:
            raise SceneError(f"person: no clothes {name!r}; there are {', '.join(CLOTHES)}")
        if len(colour) != 3 or not all(0 <= v <= 1 for v in colour):
            raise SceneError(f"person: colour of {name!r} must be RGB in [0, 1], not {colour}")
    return dict(clothes)


def _extent(body: Body) -> tuple[Float, Float]:
    """Lowest and highest points [3] of a walk, body frame."""
    times = np.linspace(0, 3, 31)
    places = np.column_stack([STROLL * times, 0 * times, 0 * times])
    gait = plan_gait(body, times, places, 0 * times)
    vertices = skin(body, joint_transforms(body, gait.pose(times[10:]))).reshape(-1, 3)
    low: Float = np.append(vertices.min(axis=0)[:2], 0.0)
    return low, vertices.max(axis=0)


def _samples(
    body: Body, triangles: NDArray[np.int64], count: int
) -> tuple[NDArray[np.int64], Float]:
    """Vertices [N, 3] of triangles, sampled by area, and barycentric coordinates [N, 3].

    The samples are deterministic.
    """
    area = _areas(body, triangles)
    # Even steps of the cumulative area leave no patch bare.
    along = (np.arange(count) + 0.5) / count * area.sum()
    chosen = triangles[np.searchsorted(np.cumsum(area), along).clip(max=len(triangles) - 1)]
    u, v = np.random.default_rng(7).random((2, count))
    root = np.sqrt(u)
    return chosen, np.column_stack([1 - root, root * (1 - v), root * v])


def _areas(body: Body, triangles: NDArray[np.int64]) -> Float:
    """Areas [T] of the parallelograms of triangles [T, 3] in the rest pose [m^2]."""
    a, b, c = (body.vertices[triangles[:, i]] for i in range(3))
    areas: Float = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas


def _bindings(
    body: Body, chosen: NDArray[np.int64], shares: Float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The four joints [N, 4] with the largest weights, and these weights."""
    model = body.model
    full = np.zeros((len(chosen), len(JOINTS)))
    rows = np.arange(len(chosen))
    for corner in range(3):
        vertices = chosen[:, corner]
        for k in range(model.weights.shape[1]):
            np.add.at(
                full,
                (rows, model.weight_joints[vertices, k]),
                shares[:, corner] * model.weights[vertices, k],
            )
    joints = np.argsort(-full, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(full, joints, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    return joints.astype(np.uint8), weights.astype(np.float32)


def _cloud(  # noqa: PLR0917 - a surface, its samples and their colours
    body: Body,
    triangles: NDArray[np.int64],
    chosen: NDArray[np.int64],
    shares: Float,
    colours: Mapping[str, tuple[float, float, float]],
    middle: float,
) -> GaussianCloud:
    corners = body.vertices[chosen]
    means = (corners * shares[..., None]).sum(axis=1) - [0.0, 0.0, middle]
    edge = corners[:, 1] - corners[:, 0]
    normal = np.cross(edge, corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    along = edge / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    frames = np.stack([along, np.cross(normal, along), normal], axis=-1)
    # A triangle has half the area of its parallelogram.
    spread = np.sqrt(_areas(body, triangles).sum() / 2 / len(chosen))
    scales = np.broadcast_to([spread, spread, THICKNESS], means.shape)
    main = chosen[np.arange(len(chosen)), shares.argmax(axis=1)]
    painted = np.array([_colour(name, colours) for name in body.model.part_names])
    # Shade with light from above, otherwise shapes look flat.
    lit = painted[body.model.parts[main]] * (0.8 + 0.2 * normal[:, 2:])
    return GaussianCloud(
        means=_tensor(means),
        quats=_tensor(matrix_to_quaternion(frames)),
        scales=_tensor(scales),
        opacities=torch.full((len(means),), OPACITY),
        sh=_tensor((lit[:, None] - 0.5) / SH_C0),
    )


def _colour(
    part: str, colours: Mapping[str, tuple[float, float, float]]
) -> tuple[float, float, float]:
    return EYES if part == "eyes" else colours[_WEARS[part.split("_", maxsplit=1)[0]]]


def _tensor(values: Float) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
