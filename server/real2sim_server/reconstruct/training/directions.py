"""From where training images show each Gaussian, and what follows for views from elsewhere.

A colour that depends on the direction can be anything across the one direction from which it was
seen, and so can what lies on sides that were only seen edge on: neither changes a training image,
and both show when a car is turned.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...scene import GaussianCloud
from ...scene.cloud import SH_C0
from ..initialise.vehicle_body import GRAZING, VehicleBody
from .model import SceneModel
from .visibility import Viewpoint, camera_from_object

NEAR = 0.2
SH_C1 = 0.4886025119029199
"""Of the basis functions of degree 1: -C1 y, C1 z, -C1 x."""
LOBE_PRIOR = 0.03
"""Variance of viewing directions at which a lobe keeps half of what was learnt."""


@dataclass(frozen=True, eq=False)
class ViewingDirections:
    """Moments of the unit directions from cameras to N Gaussians, in the frames of their owners.

    Attributes:
        views: [N] float32, in how many images a Gaussian's centre is.
        means: [N, 3] float32; 0 without any.
        seconds: [N, 3, 3] float32, means of outer products.
        facing: [N] float32, greatest cosine between a normal and the way back to a camera; -1
            where none was asked for.
    """

    views: Tensor
    means: Tensor
    seconds: Tensor
    facing: Tensor


@torch.no_grad()
def viewing_directions(
    model: SceneModel,
    viewpoints: Iterable[Viewpoint],
    *,
    normals: Tensor | None = None,
    objects_only: bool = False,
) -> ViewingDirections:
    """Over all images that hold a Gaussian's centre, whatever stands before it.

    Args:
        normals: [N, 3] of the surfaces on which Gaussians lie, in the frames of their owners.
        objects_only: leaves the background out.
    """
    gaussians, starts = model.gaussians, model.gaussians.starts
    count = len(gaussians)
    views, sums, products = (
        torch.zeros(count, *shape, device=model.device) for shape in ((), (3,), (3, 3))
    )
    facing = torch.full((count,), -1.0, device=model.device)
    flips = [False, True] if any(model.mirrored) else [False]
    for (camera, t_us), flipped in itertools.product(viewpoints, flips):
        viewmat = model.viewmat(camera, t_us).detach()
        mirrored = model.mirrored if flipped else ()
        clouds = gaussians.clouds(degree=0, mirrored=mirrored)
        instances, drawn = model.instances(clouds, t_us)
        for index, item in zip(drawn, instances, strict=True):
            reflected = index > 0 and flipped and mirrored[index - 1]
            if (flipped and not reflected) or (index == 0 and objects_only):
                continue
            rows = slice(starts[index], starts[index + 1])
            pose = camera_from_object(item, viewmat)
            local = item.cloud.means @ pose[:3, :3].T + pose[:3, 3]
            x, y, z = local.unbind(-1)
            safe = z.clamp(min=NEAR)
            u = float(camera.K[0, 0]) * x / safe + float(camera.K[0, 2])
            v = float(camera.K[1, 1]) * y / safe + float(camera.K[1, 2])
            seen = (z > NEAR) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            direction = torch.nn.functional.normalize(local, dim=-1) @ pose[:3, :3]
            if reflected:
                direction = direction * direction.new_tensor([1.0, -1, 1])
            if normals is not None:
                cosine = torch.where(seen, -(direction * normals[rows]).sum(-1), -1.0)
                facing[rows] = torch.maximum(facing[rows], cosine)
            direction = direction * seen[:, None]
            views[rows] += seen
            sums[rows] += direction
            products[rows] += direction[:, :, None] * direction[:, None]
    weight = views.clamp(min=1)
    return ViewingDirections(
        views, sums / weight[:, None], products / weight[:, None, None], facing
    )


@torch.no_grad()
def unseen_sides(
    model: SceneModel, viewpoints: Iterable[Viewpoint], bodies: Sequence[VehicleBody | None]
) -> Tensor:
    """[N] bool: on a side of a vehicle's body that no image shows but at grazing angles.

    What lies there was learnt from the outline of other sides, and shows when the vehicle turns.

    Args:
        bodies: of the objects; None where there is none to tell by.
    """
    normals, known = _body_normals(model, bodies)
    facing = viewing_directions(model, viewpoints, normals=normals, objects_only=True).facing
    return known & (facing < GRAZING)


def _body_normals(model: SceneModel, bodies: Sequence[VehicleBody | None]) -> tuple[Tensor, Tensor]:
    """Outward normals [N, 3] of the bodies where Gaussians are nearest to them, and [N] bool:
    where there is one."""
    gaussians, starts = model.gaussians, model.gaussians.starts
    normals = torch.zeros_like(gaussians.means)
    known = torch.zeros(len(gaussians), dtype=torch.bool, device=model.device)
    for index, body in enumerate(bodies):
        rows = slice(starts[index + 1], starts[index + 2])
        if body is not None and rows.stop > rows.start:
            means = gaussians.means[rows].detach().cpu().numpy().astype(np.float64)
            found = torch.from_numpy(body.normals[body.nearest(means)])
            normals[rows] = found.to(normals)
            known[rows] = True
    return normals, known


@torch.no_grad()
def paint_unseen_sides(
    model: SceneModel, viewpoints: Sequence[Viewpoint], bodies: Sequence[VehicleBody | None]
) -> None:
    """Give sides of vehicles that images show only edge on the colours of stage 0 from ahead.

    The colour of a Gaussian there goes linearly from what was learnt, in the mean direction of the
    images, to what initialisation has at its place, against the normal. What images show stays.
    """
    normals, known = _body_normals(model, bodies)
    seen = viewing_directions(model, viewpoints, normals=normals, objects_only=True)
    sh = model.gaussians.sh
    rows = (known & (seen.facing < GRAZING)).nonzero()[:, 0]
    if sh.shape[1] < 4 or not len(rows):
        return
    signs = sh.new_tensor([-1.0, -1.0, 1.0])[:, None]
    slopes = sh[rows, 1:4].roll(1, dims=1) * signs * SH_C1
    mean = seen.means[rows]
    shown = 0.5 + SH_C0 * sh[rows, 0] + (slopes * mean[:, :, None]).sum(1)
    wanted = _initial_colours(model, rows)
    way = -normals[rows] - mean
    way /= way.square().sum(-1, keepdim=True).clamp(min=0.5)
    slopes = way[:, :, None] * (wanted - shown)[:, None]
    constant = shown - (slopes * mean[:, :, None]).sum(1)
    sh[rows, 0] = (constant - 0.5) / SH_C0
    sh[rows, 1:4] = (slopes * signs / SH_C1).roll(-1, dims=1)
    sh[rows, 4:] = 0


def _initial_colours(model: SceneModel, rows: Tensor) -> Tensor:
    """Colours [M, 3] that stage 0 has where the Gaussians ``rows`` [M] of objects are."""
    from scipy.spatial import cKDTree

    starts = model.gaussians.starts
    colours = torch.zeros(len(rows), 3, device=model.device)
    for index, item in enumerate(model.scene.objects.values()):
        mine = (rows >= starts[index + 1]) & (rows < starts[index + 2])
        if not bool(mine.any()) or not len(item.cloud):
            continue
        tree = cKDTree(item.cloud.means.detach().cpu().numpy())
        _, near = tree.query(model.gaussians.means[rows[mine]].detach().cpu().numpy(), k=1)
        colours[mine] = constant_colours(item.cloud)[torch.from_numpy(near)].to(colours)
    return colours


def constant_colours(cloud: GaussianCloud) -> Tensor:
    """The part of colours [N, 3] that does not depend on the direction."""
    return 0.5 + SH_C0 * cloud.sh[:, 0]


@torch.no_grad()
def plain_lobes(model: SceneModel, seen: ViewingDirections, *, prior: float = LOBE_PRIOR) -> None:
    """Move objects' colours that depend on the direction into constant ones, where views were few.

    A ridge regression of the linear lobes on the colours that were seen: what they say across the
    directions of training goes, what the mean direction showed stays to the bit of rounding.
    """
    objects = slice(model.gaussians.counts[0], None)
    sh, means = model.gaussians.sh[objects], seen.means[objects]
    if sh.shape[1] < 4:
        return
    covariance = seen.seconds[objects] - means[:, :, None] * means[:, None]
    eye = torch.eye(3, device=sh.device)
    kept = torch.linalg.solve(covariance + prior * eye, covariance)
    # Lobes lie in the order y, z, x.
    signs = sh.new_tensor([-1.0, -1.0, 1.0])[:, None]
    slopes = sh[:, 1:4].roll(1, dims=1) * signs * SH_C1
    less = kept @ slopes
    colour = ((slopes - less) * means[:, :, None]).sum(1)
    sh[:, 0] += colour / SH_C0
    sh[:, 1:4] = (less * signs / SH_C1).roll(-1, dims=1)
    # Lobes of higher degree shrink as much as the mean of the three.
    factor = kept.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    sh[:, 4:] *= factor
