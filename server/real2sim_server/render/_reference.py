"""The plain torch rasterizer: slow, simple and differentiable; the reference for other backends.

Semantics are those of gsplat 1.5.3 ``rasterization`` (classic EWA splatting, Zwicker et al. 2001;
Kerbl et al. 2023), except that depths are compared after rounding the float64 depth to float32.

Cameras with lenses and rolling shutters evaluate every Gaussian for every ray, where its response
along the ray is largest (Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing): there is no
projection, and only contributions below ALPHA_MIN are left out. The blur of a pixel is that of the
pinhole at the Gaussian's centre.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry import Float
from ..scene.camera import turned
from ..scene.cloud import evaluate_sh
from .backend import (
    ALPHA_MAX,
    ALPHA_MIN,
    CLAMP_MARGIN,
    TRANSMITTANCE_MIN,
    Placement,
    RasterRequest,
    ScreenTracker,
    ScreenWatch,
    needs_gradients,
    pixel_directions,
    place_instances,
    with_colours,
)
from .lens import LensView, continued, tables_of
from .types import Instance, RenderError, RenderOutput


class Blended(Protocol):
    """N splats, front to back."""

    @property
    def colors(self) -> Tensor:
        """[N, 3]."""
        ...

    @property
    def depths(self) -> Tensor:
        """[N] [m]."""
        ...

    @property
    def instance_ids(self) -> Tensor:
        """[N]."""
        ...


def blend(splats: Blended, alpha: Tensor, size: tuple[int, ...]) -> tuple[Tensor, ...]:
    """Colour [*size, 3], opacity, depth, instance and median depth [*size] of pixels.

    Args:
        splats: N splats, front to back.
        alpha: [N, pixels], alpha of each splat at each pixel.
        size: shape of the output.
    """
    dtype = alpha.dtype
    after = torch.cumprod(1 - alpha, dim=0)
    alpha = torch.where(after > TRANSMITTANCE_MIN, alpha, 0.0)
    after = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([torch.ones(1, after.shape[1], dtype=dtype), after[:-1]])[: len(after)]
    weights = alpha * before
    total = 1 - torch.prod(1 - alpha, dim=0)
    rgb = weights.mT @ splats.colors
    depth = (weights.mT @ splats.depths) / torch.where(total > 0, total, 1.0)

    crossing = (before > 0.5) & (after <= 0.5)
    instance = (crossing * splats.instance_ids[:, None]).sum(0)
    median = (crossing * splats.depths.detach()[:, None]).sum(0)
    rest = (image.reshape(size) for image in (total, depth, instance, median))
    return rgb.reshape(*size, 3), *rest


# Cameras with lenses and rolling shutters

STEP = 1e-5
"""Step of finite differences, relative to the distance."""
ROUNDS = 4
"""Iterations for the row and the exposure time of a centre."""
ROWS = 8
"""Pixel rows blended at once."""


@dataclass(frozen=True, eq=False)
class RaySplats:
    """V Gaussians in the mid-readout camera frame.

    Attributes:
        roots: [V, 3, 3] inverse Cholesky factors of their covariances.
        centres, ways: [V, 3] positions, and displacements relative to the camera over the readout
            [m].
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
        """The splats ``index``, in that order."""
        return RaySplats(*(tensor[index] for tensor in vars(self).values()))


def blend_rays(
    request: RasterRequest,
    placement: Placement,
    covariances: Callable[[Instance, torch.dtype], Tensor],
    dtype: torch.dtype,
) -> tuple[Tensor, ...]:
    """RGB without background, alpha, depth, instance and median depth of the request's camera, and
    the mask of pixels inside the lens."""
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
    """Time [H, W] of every pixel, -0.5 to 0.5 over the readout."""
    camera = optics.camera
    times = np.zeros((camera.height, camera.width))
    if camera.shutter.rolls:
        lines = optics.lines()
        times += lines[:, None] if camera.shutter.by_row else lines
    return times


def _splats(
    request: RasterRequest, placement: Placement, index: int, covars: Tensor, dtype: torch.dtype
) -> RaySplats:
    """Gaussians of one instance between the near and far plane."""
    optics, instance, options = request.optics, request.instances[index], request.options
    assert optics is not None
    cloud, camera = instance.cloud, optics.camera
    linear, offset = placement.linear[0, index], placement.offset[0, index]
    own = cloud.means.double() @ linear.mT
    centres, ways = own + offset, _readout_displacements(instance, optics, own)
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


def _readout_displacements(instance: Instance, optics: LensView, own: Tensor) -> Tensor:
    """Displacement of centres relative to the camera over the readout [m].

    ``own`` [N, 3] are the centres relative to the origin of their instance.
    """
    ways = torch.zeros_like(own) - torch.from_numpy(optics.shift)
    if instance.twist is None or not optics.moves:
        return ways
    turn = optics.middle[:3, :3]
    linear, angular = torch.from_numpy(instance.twist.reshape(2, 3) @ turn * optics.seconds)
    found: Tensor = ways + linear + torch.linalg.cross(angular.expand_as(own), own)
    return found


def _derivatives(optics: LensView, centres: Float, ways: Float) -> tuple[Tensor, Tensor]:
    """Derivatives [N, 2, 3] of image positions, in the mid-readout camera frame, and positions
    [N, 3] in the camera frame at the exposure time of each centre."""
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
    """Exposure time of image positions [N, 2], -0.5 to 0.5 over the readout."""
    axis = 1 if optics.camera.shutter.by_row else 0
    lines = optics.lines()
    return np.interp(positions[:, axis] - 0.5, np.arange(len(lines)), lines)


def _blur(axes: Tensor, centres: Tensor, eps2d: float) -> Tensor:
    """Covariances [N, 3, 3] of the pixel blur at the centres: ``eps2d`` across the ray, and about
    the same along it."""
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


# The rasterizer

TILE = 32


class ReferenceBackend:
    """Plain torch on the CPU, made differentiable by torch itself.

    Args:
        dtype: float32 or float64, dtype of computations after placement.
        image_dtype: dtype of output images; float64 for finite differences.
    """

    name = "reference"
    draws_lenses = True

    def __init__(
        self, dtype: torch.dtype = torch.float64, image_dtype: torch.dtype = torch.float32
    ) -> None:
        self.dtype = dtype
        self.image_dtype = image_dtype

    def warm_up(self) -> None:
        """Nothing to compile."""

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw one camera after the other, tile by tile."""
        start = time.perf_counter()
        request = with_colours(request)
        placement = place_instances(request.instances, request.viewmats)
        options = request.options
        tracker = None
        if options.track_screen and needs_gradients(request):
            tracker = ScreenTracker(request)
        if request.optics is None:
            images = [self._camera(request, placement, c, tracker) for c in range(request.cameras)]
        else:
            images = [self._rays(request, placement)]
        rgb, alpha, depth, instance, median = (
            torch.stack([image[k] for image in images]) for k in range(5)
        )
        return RenderOutput(
            rgb=rgb.to(self.image_dtype),
            alpha=alpha.to(self.image_dtype),
            depth=depth.to(self.image_dtype) if options.depth else None,
            instance=instance.to(torch.uint16) if options.instance else None,
            timing_ms={"total": (time.perf_counter() - start) * 1e3},
            screen=tracker.statistics if tracker else None,
            median_depth=median.to(self.image_dtype) if options.median_depth else None,
        )

    def _rays(self, request: RasterRequest, placement: Placement) -> tuple[Tensor, ...]:
        optics = request.optics
        rgb, *images, seen = blend_rays(request, placement, _covariances, self.dtype)
        behind = torch.tensor(request.options.background, dtype=self.dtype)
        if request.sky is not None and optics is not None:
            turn = torch.from_numpy(optics.middle[:3, :3]).float()
            rays = torch.from_numpy(optics.rays())
            behind = request.sky.sample(torch.where(seen[..., None], rays, 1.0) @ turn.mT)
        rgb = rgb + (1 - images[0])[..., None] * behind.to(self.dtype)
        return torch.where(seen[..., None], rgb, 0.0), *images

    def _camera(
        self,
        request: RasterRequest,
        placement: Placement,
        camera: int,
        tracker: ScreenTracker | None,
    ) -> tuple[Tensor, ...]:
        splats = _concatenate(
            [
                _project(request, placement, camera, index, self.dtype)
                for index in range(len(request.instances))
            ],
            self.dtype,
        )
        splats = splats.select(torch.argsort(splats.depth_key, stable=True))
        watch = None
        if tracker is not None:
            watch = tracker.watch(camera, splats.owners, splats.means2d, splats.extents)
        images = _blend_image(splats, request.width, request.height, watch)
        behind = _behind(request, camera, self.dtype)
        rgb = images[0] + (1 - images[1])[..., None] * behind
        return rgb, *images[1:]


@dataclass(frozen=True, eq=False)
class _Splats:
    """V Gaussians on the image plane; in blending order after sorting.

    ``owners`` [V, 2] int64 has the indices of the instance and of the Gaussian in it.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    depth_key: Tensor
    extents: Tensor
    instance_ids: Tensor
    owners: Tensor

    def select(self, index: Tensor) -> _Splats:
        return _Splats(*(tensor[index] for tensor in vars(self).values()))


def _concatenate(parts: list[_Splats], dtype: torch.dtype) -> _Splats:
    if not parts:
        shapes = ((0, 2), (0, 3), (0,), (0, 3), (0,), (0,), (0, 2), (0,))
        empty = [torch.zeros(shape, dtype=dtype) for shape in shapes]
        owners = torch.zeros(0, 2, dtype=torch.int64)
        return _Splats(*[*empty, owners])
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return _Splats(*(torch.cat(column) for column in columns))


def _project(
    request: RasterRequest, placement: Placement, camera: int, index: int, dtype: torch.dtype
) -> _Splats:
    """Gaussians of one instance that may touch the image of one camera."""
    instance, options = request.instances[index], request.options
    cloud = instance.cloud
    linear64, offset64 = placement.linear[camera, index], placement.offset[camera, index]
    means64 = cloud.means.double()
    depths64 = (linear64[2, 0] * means64[:, 0] + linear64[2, 1] * means64[:, 1]) + linear64[
        2, 2
    ] * means64[:, 2]
    depths64 = depths64 + offset64[2]
    depth_key = depths64.detach().float()
    in_range = (depth_key >= options.near_plane) & (depth_key <= options.far_plane)

    linear = linear64.to(dtype)
    means = (means64 @ linear64.mT + offset64).to(dtype)
    covars = linear @ _covariances(instance, dtype) @ linear.mT
    K = request.Ks[camera].to(dtype)
    z = torch.where(in_range, means[:, 2], 1.0)
    means2d = torch.stack(
        [K[0, 0] * means[:, 0] / z + K[0, 2], K[1, 1] * means[:, 1] / z + K[1, 2]], dim=-1
    )
    jacobian = _jacobian(means, z, K, request.width, request.height)
    sharp = jacobian @ covars @ jacobian.mT
    blurred = sharp + options.eps2d * torch.eye(2, dtype=dtype)
    determinant = torch.linalg.det(blurred)
    opacities = cloud.opacities.to(dtype)
    if options.rasterize_mode == "antialiased":
        ratio = torch.linalg.det(sharp).clamp(min=0) / determinant
        opacities = opacities * ratio.clamp(min=1e-30).sqrt()

    reach = (2 * (opacities.detach() / ALPHA_MIN).clamp(min=1).log()).sqrt()
    extents = reach[:, None] * blurred.detach().diagonal(dim1=-2, dim2=-1).sqrt()
    large = (extents.ceil() > options.radius_clip).any(-1)
    kept = in_range & (determinant > 0) & (opacities >= ALPHA_MIN) & large
    conics = torch.stack([blurred[:, 1, 1], -blurred[:, 0, 1], blurred[:, 0, 0]], dim=-1)
    directions = means64 * placement.scale[index] - placement.camera_position[camera, index]
    splats = _Splats(
        means2d=means2d,
        conics=conics / determinant[:, None],
        opacities=opacities,
        colors=(evaluate_sh(cloud.sh.to(dtype), directions.to(dtype)) + 0.5).clamp(min=0),
        depths=means[:, 2],
        depth_key=depth_key,
        extents=extents,
        instance_ids=torch.full((len(cloud),), instance.instance_id),
        owners=torch.stack([torch.full((len(cloud),), index), torch.arange(len(cloud))], -1),
    )
    return splats.select(kept.nonzero()[:, 0])


def _covariances(instance: Instance, dtype: torch.dtype) -> Tensor:
    """Covariances [N, 3, 3] in the cloud frame."""
    if instance.covars is not None:
        covars = instance.covars.to(dtype)
        return (covars + covars.mT) / 2
    quats = torch.nn.functional.normalize(instance.cloud.quats.to(dtype), dim=-1)
    w, x, y, z = quats.unbind(-1)
    rotation = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        dim=-2,
    )
    factor = rotation * instance.cloud.scales.to(dtype)[:, None, :]
    return factor @ factor.mT


def _jacobian(means: Tensor, z: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """Jacobians [N, 2, 3] of the pinhole projection, its angles clamped near the image."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = CLAMP_MARGIN * 0.5 * width / fx, CLAMP_MARGIN * 0.5 * height / fy
    tx = (means[:, 0] / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
    ty = (means[:, 1] / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    return torch.stack(
        [
            torch.stack([fx / z, zero, -fx * tx / z], -1),
            torch.stack([zero, fy / z, -fy * ty / z], -1),
        ],
        dim=-2,
    )


def _blend_image(
    splats: _Splats, width: int, height: int, watch: ScreenWatch | None
) -> tuple[Tensor, ...]:
    """RGB without background, alpha, depth, instance and median depth of the image, blended in
    square tiles."""
    rows = []
    for y0 in range(0, height, TILE):
        y1 = min(y0 + TILE, height)
        touches_rows = _overlaps(splats, 1, y0, y1)
        tiles = []
        for x0 in range(0, width, TILE):
            x1 = min(x0 + TILE, width)
            touching = (touches_rows & _overlaps(splats, 0, x0, x1)).nonzero()[:, 0]
            dx, dy = _offsets(splats.means2d[touching], x0, x1, y0, y1)
            if watch is not None:
                watch.gather(touching, dx, dy)
            tiles.append(_blend_pixels(splats.select(touching), dx, dy, (y1 - y0, x1 - x0)))
        rows.append([torch.cat(column, dim=1) for column in zip(*tiles, strict=True)])
    return tuple(torch.cat(column, dim=0) for column in zip(*rows, strict=True))


def _overlaps(splats: _Splats, axis: int, low: int, high: int) -> Tensor:
    centre, extent = splats.means2d[:, axis].detach(), splats.extents[:, axis]
    return (centre + extent >= low) & (centre - extent <= high)


def _offsets(means2d: Tensor, x0: int, x1: int, y0: int, y1: int) -> tuple[Tensor, Tensor]:
    """Offsets dx, dy [V, pixels] from V centres to the pixel centres of [y0, y1) x [x0, x1)."""
    dtype = means2d.dtype
    py, px = torch.meshgrid(
        torch.arange(y0, y1, dtype=dtype) + 0.5,
        torch.arange(x0, x1, dtype=dtype) + 0.5,
        indexing="ij",
    )
    return px.reshape(1, -1) - means2d[:, :1], py.reshape(1, -1) - means2d[:, 1:]


def _blend_pixels(
    splats: _Splats, dx: Tensor, dy: Tensor, size: tuple[int, int]
) -> tuple[Tensor, ...]:
    """Front-to-back blending of sorted splats in one tile of ``size`` (height, width)."""
    a, b, c = splats.conics[:, 0:1], splats.conics[:, 1:2], splats.conics[:, 2:3]
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (splats.opacities[:, None] * torch.exp(-sigma)).clamp(max=ALPHA_MAX)
    alpha = torch.where((sigma >= 0) & (alpha >= ALPHA_MIN), alpha, 0.0)

    return blend(splats, alpha, size)


def _behind(request: RasterRequest, camera: int, dtype: torch.dtype) -> Tensor:
    """Colour behind everything, [3] or [H, W, 3]."""
    if request.sky is None:
        return torch.tensor(request.options.background, dtype=dtype)
    return request.sky.sample(pixel_directions(request, camera)).to(dtype)
