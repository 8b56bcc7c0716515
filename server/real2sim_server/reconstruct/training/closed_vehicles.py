"""Complete the parts of vehicles that no image shows.

The body fitted into a vehicle's box fills the unseen parts, in the vehicle's paint.

If all images look along one direction, they do not determine depth: the tail of a followed vehicle
is learnt as a cloud metres deep and falls apart when the vehicle turns. This module projects that
cloud along the viewing rays onto the body, with almost no change to the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...geometry import matrix_to_quaternion
from ...scene import GaussianCloud, Scene, SceneObject
from ...scene.cloud import SH_C0
from ..initialise.vehicle_body import SPACING, WIDE_SPACING, VehicleBody, body_colours
from . import kernels
from .densify import SelectiveAdam, rotation_matrices
from .gaussians import FIELDS, OBJECT_FIELDS
from .model import SceneModel
from .visibility import (
    OfferedPriors,
    ViewingDirections,
    Viewpoint,
    viewing_directions,
)

ONE_DIRECTION = float(np.radians(5))
"""Root mean square angle up to which viewing directions count as one direction."""
KEPT_DEPTH = 0.05
"""Remaining fraction of the depth about a surface, so that the order in depth is preserved."""
MIN_SPREAD = 2e-3
"""Minimum standard deviation of projected Gaussians [m]."""
SHADOW = 0.3
"""The ground plate that carries shadows extends this far beyond the box [m]."""
INSETS = (1.0, 0.96, 0.92, 0.87, 0.82)
"""Factors by which a body may be narrower and lower where images show it beyond the vehicle's
outline."""
DISC, BENT = (0.55, 0.55, 0.15), (0.45, 0.45, 0.15)
"""Standard deviation of a body's Gaussians relative to their spacing, on flat surfaces and at bends
and borders. Larger ones reach beyond the outline, and nearer parts cover the edge of farther ones.
"""


@torch.no_grad()
def close_followed(
    model: SceneModel,
    optimizer: SelectiveAdam,
    viewpoints: Sequence[Viewpoint],
    bodies: Sequence[VehicleBody | None],
) -> list[bool]:
    """Project followed vehicles onto their bodies, in place.

    Args:
        bodies: bodies of the objects; None for objects without a body.

    Returns:
        Whether each object was projected.
    """
    seen = viewing_directions(model, viewpoints, objects_only=True)
    followed = []
    for index, item in enumerate(model.scene.objects.values()):
        body, rows = bodies[index], _followed_rows(model, seen, index)
        followed.append(body is not None and len(rows) > 0)
        if body is not None and len(rows):
            _press(model, optimizer, rows, seen.means[rows], _surface(body, item.size))
    return followed


def offer_bodies(
    model: SceneModel, followed: Sequence[bool], bodies: Sequence[VehicleBody | None]
) -> OfferedPriors:
    """Bodies with the paint of stage 0, as priors for all vehicles that have a body.

    Args:
        followed: per object, whether only its outline determines its width; such bodies are offered
            in several INSETS.
        bodies: bodies of the objects; None for objects without a body.
    """
    scene = model.scene
    objects, alternatives = dict(scene.objects), [_no_choice(len(scene.background))]
    for index, (name, item) in enumerate(scene.objects.items()):
        body, insets = bodies[index], INSETS if followed[index] else INSETS[:1]
        if body is not None:
            cloud = body_cloud(body, item, scene, insets=insets)
            objects[name] = replace(item, cloud=cloud)
            alternatives.append(torch.arange(len(cloud) // len(insets)).repeat(len(insets)))
        else:
            alternatives.append(_no_choice(len(item.cloud)))
    # One inset is inserted per body point; the numbers are unique across objects.
    numbered = [a + (a >= 0) * (i << 32) for i, a in enumerate(alternatives)]
    return OfferedPriors(replace(scene, objects=objects), torch.cat(numbered))


def body_cloud(
    body: VehicleBody, item: SceneObject, scene: Scene, *, insets: Sequence[float]
) -> GaussianCloud:
    """The whole body once for each inset, in the paint of ``item``, an object of stage 0.

    Flat regions of a single part get fewer, larger Gaussians, borders of parts smaller ones.
    """
    drawn = body.drawn > 0
    spacing = body.drawn[drawn, None]
    scales = spacing * np.where(spacing < WIDE_SPACING, BENT, DISC).astype(np.float32)
    colours = body_colours(body, item, scene)[drawn]
    factors = np.array([(1 - 0.4 * (1 - f), f, f) for f in insets])
    normals = body.unit_normals()[drawn]
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]])
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normals, first), normals], axis=2)
    copies = len(insets)
    means = (factors[:, None] * body.points[drawn]).reshape(-1, 3)
    cloud = GaussianCloud(
        means=torch.from_numpy(means).float(),
        quats=torch.from_numpy(matrix_to_quaternion(axes)).float().repeat(copies, 1),
        scales=torch.from_numpy(scales).repeat(copies, 1),
        opacities=torch.full((len(means),), 0.99),
        sh=torch.from_numpy((colours - 0.5) / SH_C0)[:, None].float().repeat(copies, 1, 1),
    )
    return cloud.to(item.cloud.device)


def _no_choice(count: int) -> Tensor:
    return torch.full((count,), -1, dtype=torch.int64)


def _followed_rows(model: SceneModel, seen: ViewingDirections, index: int) -> Tensor:
    """Gaussians [M] of an object that images show from one direction only."""
    starts = model.gaussians.starts
    rows = torch.arange(starts[index + 1], starts[index + 2], device=model.device)
    rows = rows[seen.views[rows] > 0]
    means = seen.means[rows]
    scatter = seen.seconds[rows].diagonal(dim1=-2, dim2=-1).sum(-1) - means.square().sum(-1)
    one = scatter < ONE_DIRECTION**2
    return rows[one] if len(rows) and bool(one.float().mean() > 0.5) else rows[:0]


def _surface(body: VehicleBody, size: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """Points and normals [P, 3] of a body and of the ground under it."""
    length, width, height = size
    x, y = (
        np.arange(-0.5 * side - SHADOW, 0.5 * side + SHADOW, SPACING) for side in (length, width)
    )
    plate = np.stack([*(g.ravel() for g in np.meshgrid(x, y)), np.zeros(len(x) * len(y))], axis=1)
    plate[:, 2] = 0.02 - height / 2
    points = np.concatenate([body.points, plate])
    normals = np.concatenate([body.normals, np.tile([0.0, 0, 1], (len(plate), 1))])
    return torch.from_numpy(points).float(), torch.from_numpy(normals).float()


def _press(
    model: SceneModel,
    optimizer: SelectiveAdam,
    rows: Tensor,
    directions: Tensor,
    surface: tuple[Tensor, Tensor],
) -> None:
    """Move Gaussians ``rows`` [M] along ``directions`` [M, 3] onto a surface, in place.

    A shear along the rays reduces the depth about the surface to KEPT_DEPTH of its value. Seen
    along the rays, centres stay in place, and so do outlines, except of Gaussians that would get
    longer than they were.
    """
    gaussians = model.gaussians
    rays = normalize(directions, dim=-1).cpu()
    means = gaussians.means[rows].cpu()
    distance, normal = _hits(means, rays, *surface)
    cosine = (normal * rays).sum(-1)
    outer = rays[:, :, None] * normal[:, None] / cosine[:, None, None]
    shear = torch.eye(3) - (1 - KEPT_DEPTH) * outer
    axes = rotation_matrices(gaussians.quats[rows]) * gaussians.log_scales[rows].exp()[:, None]
    axes = (shear @ axes.cpu()).double()
    squares, turns = torch.linalg.eigh(axes @ axes.transpose(1, 2))
    turns = turns * torch.linalg.det(turns).sign()[:, None, None]
    quats = torch.from_numpy(matrix_to_quaternion(turns.numpy()))
    # Rays that graze the surface would stretch a Gaussian into a long streak on it.
    largest = gaussians.log_scales[rows].amax(dim=1).exp().cpu()
    scales = squares.clamp(min=MIN_SPREAD**2).sqrt().float().minimum(largest[:, None])
    changed = {
        "means": means + rays * (distance * (1 - KEPT_DEPTH))[:, None],
        "quats": quats,
        "log_scales": scales.log(),
    }
    for name, values in changed.items():
        parameter = getattr(gaussians, name)
        parameter[rows] = values.to(parameter)
    for name in FIELDS:
        if name not in OBJECT_FIELDS:
            optimizer.reset_moments(name, rows)


def _hits(origins: Tensor, rays: Tensor, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """First intersection of lines through ``origins`` [M, 3] along unit ``rays`` with a point
    surface.

    Returns:
        Distances [M] along the rays [m] and normals [M, 3] there, against the rays. Lines that miss
        get the distance of closest approach, and the ray itself as normal.
    """
    distances, at = np.empty(len(origins), np.float32), np.empty((len(origins), 3), np.float32)
    surface = (np.ascontiguousarray(part.T.numpy()) for part in (points, normals))
    kernels.first_hits(origins.numpy(), rays.numpy(), *surface, distances, at)
    return torch.from_numpy(distances), torch.from_numpy(at)
