"""Cameras with lenses and rolling shutters in plain torch: every Gaussian for every ray.

The response of a Gaussian is taken where it is largest along the ray (Moenne-Loccoz et al. 2024,
3D Gaussian Ray Tracing): there is no projection, and nothing is left out but what shows less than
ALPHA_MIN. The blur of a pixel is that of the pinhole at the place of the Gaussian's centre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.rotation import Float
from ...scene.camera_motion import turned
from ...scene.spherical_harmonics import evaluate_sh
from ..lens_view import LensView, continued, tables_of
from ..types import Instance, RenderError
from .base import ALPHA_MAX, ALPHA_MIN, Placement, RasterRequest
from .front_to_back import blend

STEP = 1e-5
"""Of finite differences, relative to the distance."""
ROUNDS = 4
"""In which the row of a centre and its time settle."""
ROWS = 8
"""Rows of pixels that are blended at once."""


@dataclass(frozen=True, eq=False)
class RaySplats:
    """V Gaussians in the camera's frame in the middle of the read-out.

    Attributes:
        roots: [V, 3, 3] inverse Cholesky roots of their covariances.
        centres, ways: [V, 3] where they are, and how far they go over the read-out before the
            camera [m].
        opacities, depths: [V].
        colors: [V, 3].
        depth_key: [V] float32.
        instance_ids: [V].
    """

    roots: Tensor
    centres: Tensor
    ways: Tensor
    opacities: Tensor
    depths: Tensor
    colors: Tensor
    depth_key: Tensor
    instance_ids: Tensor

    def select(self, index: Tensor) -> RaySplats:
        """Some of them, in that order."""
        return RaySplats(*(tensor[index] for tensor in vars(self).values()))


def blend_rays(
    request: RasterRequest,
    placement: Placement,
    covariances: Callable[[Instance, torch.dtype], Tensor],
    dtype: torch.dtype,
) -> tuple[Tensor, ...]:
    """RGB without background, alpha, depth, instance and median depth of the request's camera, and
    which of its pixels see anything."""
    optics = request.optics
    if optics is None:
        raise RenderError("a request without optics has no rays")
    parts = [
        _splats(request, placement, index, covariances(instance, dtype), dtype)
        for index, instance in enumerate(request.instances)
    ]
    rays = torch.from_numpy(optics.rays()).to(dtype)
    times = torch.from_numpy(_pixel_times(optics)).to(dtype)
    seen = (rays != 0).any(-1)
    if not parts:
        empty = torch.zeros(seen.shape, dtype=dtype)
        return torch.zeros(*seen.shape, 3, dtype=dtype), *(empty,) * 4, seen
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    splats = RaySplats(*(torch.cat(column) for column in columns))
    splats = splats.select(torch.argsort(splats.depth_key, stable=True))
    bands = [
        _blend(splats, rays[row : row + ROWS], times[row : row + ROWS])
        for row in range(0, request.height, ROWS)
    ]
    return *(torch.cat(column) for column in zip(*bands, strict=True)), seen


def _pixel_times(optics: LensView) -> NDArray[np.float64]:
    """Time [H, W] of every pixel, -0.5 to 0.5 over the read-out."""
    camera = optics.camera
    times = np.zeros((camera.height, camera.width))
    if camera.shutter.rolls:
        lines = optics.lines()
        times += lines[:, None] if camera.shutter.by_row else lines
    return times


def _splats(
    request: RasterRequest, placement: Placement, index: int, covars: Tensor, dtype: torch.dtype
) -> RaySplats:
    """Gaussians of one instance that are between the planes."""
    optics, instance, options = request.optics, request.instances[index], request.options
    assert optics is not None
    cloud, camera = instance.cloud, optics.camera
    linear, offset = placement.linear[0, index], placement.offset[0, index]
    own = cloud.means.double() @ linear.mT
    centres, ways = own + offset, _ways(instance, optics, own)
    axes, positions = _derivatives(optics, centres.detach().numpy(), ways.detach().numpy())
    depths = positions.norm(dim=-1) if camera.shows_ranges else positions[:, 2]
    covars = linear.to(dtype) @ covars @ linear.to(dtype).mT
    sharp = axes.to(dtype) @ covars @ axes.to(dtype).mT
    eps = options.eps2d * torch.eye(2, dtype=dtype)
    opacities = cloud.opacities.to(dtype)
    if options.rasterize_mode == "antialiased":
        ratio = torch.linalg.det(sharp).clamp(min=0) / torch.linalg.det(sharp + eps)
        opacities = opacities * ratio.clamp(min=1e-30).sqrt()
    roots = torch.linalg.cholesky(covars + _blur(axes, centres, options.eps2d).to(dtype))
    directions = cloud.means.double() * placement.scale[index] - placement.camera_position[0, index]
    colors = evaluate_sh(cloud.sh.to(dtype), directions.to(dtype)) + 0.5
    splats = RaySplats(
        roots=torch.linalg.inv(roots),
        centres=centres.to(dtype),
        ways=ways.to(dtype),
        opacities=opacities,
        depths=depths.to(dtype),
        colors=colors.clamp(min=0),
        depth_key=depths.detach().float(),
        instance_ids=torch.full((len(cloud),), instance.instance_id),
    )
    kept = (splats.depth_key >= options.near_plane) & (splats.depth_key <= options.far_plane)
    return splats.select((kept & (opacities >= ALPHA_MIN)).nonzero()[:, 0])


def _ways(instance: Instance, optics: LensView, own: Tensor) -> Tensor:
    """How far centres go over the read-out as the camera sees it, ``own`` [N, 3] from the origin of
    their instance."""
    ways = torch.zeros_like(own) - torch.from_numpy(optics.shift)
    if instance.twist is None or not optics.moves:
        return ways
    turn = optics.middle[:3, :3]
    linear, angular = torch.from_numpy(instance.twist.reshape(2, 3) @ turn * optics.seconds)
    found: Tensor = ways + linear + torch.linalg.cross(angular.expand_as(own), own)
    return found


def _derivatives(optics: LensView, centres: Float, ways: Float) -> tuple[Tensor, Tensor]:
    """Derivatives [N, 2, 3] of image positions, in the frame of the middle of the read-out, and
    positions [N, 3] in that of the time at which the camera sees them."""
    camera = optics.camera
    position = continued(camera, tables_of(camera).reach)
    turns = np.broadcast_to(np.eye(3), (len(centres), 3, 3))
    seen = centres
    for _ in range(ROUNDS if optics.moves else 0):
        times = _line_times(optics, position(seen))
        turns = np.stack([turned(-time * optics.turn) for time in times])
        seen = np.einsum("nij,nj->ni", turns, centres + ways * times[:, None])
    step = STEP * np.linalg.norm(seen, axis=1, keepdims=True)
    columns = []
    for k in range(3):
        along = np.eye(3)[k] * step
        columns.append((position(seen + along) - position(seen - along)) / step)
    axes = np.stack(columns, -1) / 2 @ turns
    return torch.from_numpy(axes), torch.from_numpy(seen)


def _line_times(optics: LensView, positions: Float) -> Float:
    """When the rows or columns of image positions [N, 2] are taken, -0.5 to 0.5."""
    axis = 1 if optics.camera.shutter.by_row else 0
    lines = optics.lines()
    return np.interp(positions[:, axis] - 0.5, np.arange(len(lines)), lines)


def _blur(axes: Tensor, centres: Tensor, eps2d: float) -> Tensor:
    """Covariances [N, 3, 3] of a pixel's blur at the centres: as wide as ``eps2d`` across the ray,
    and about as much along it."""
    square = axes @ axes.mT
    square = square + 1e-12 * torch.eye(2, dtype=axes.dtype)
    inverse = torch.linalg.inv(square)
    across = axes.mT @ inverse @ inverse @ axes
    deep = torch.linalg.det(inverse).sqrt() / (centres * centres).sum(-1)
    along = deep[:, None, None] * (centres[:, :, None] * centres[:, None, :])
    blur: Tensor = eps2d * (across + along.detach())
    return blur


def _blend(splats: RaySplats, rays: Tensor, times: Tensor) -> tuple[Tensor, ...]:
    """Front-to-back blending of sorted Gaussians along rays [h, W, 3] at times [h, W]."""
    shape = times.shape
    directions, times = rays.reshape(-1, 3), times.reshape(-1)
    towards = torch.einsum("vij,pj->vpi", splats.roots, directions)
    away = torch.einsum("vij,vj->vi", splats.roots, splats.centres)[:, None]
    away = away + times[:, None] * torch.einsum("vij,vj->vi", splats.roots, splats.ways)[:, None]
    beside = torch.linalg.cross(away, towards, dim=-1).square().sum(-1)
    sigma = 0.5 * beside / towards.square().sum(-1)
    alpha = (splats.opacities[:, None] * torch.exp(-sigma)).clamp(max=ALPHA_MAX)
    ahead = (away * towards).sum(-1) > 0
    alpha = torch.where(ahead & (alpha >= ALPHA_MIN), alpha, 0.0)
    return blend(splats, alpha, shape)
