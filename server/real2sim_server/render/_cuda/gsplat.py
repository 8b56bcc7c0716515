"""The CUDA backend: gsplat behind the common interface.

The device transforms objects to world means and covariances and evaluates their colours in their
own frames, then gsplat blends them. This module is imported only if CUDA is requested.
"""

from __future__ import annotations

import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ...scene import GaussianCloud
from ..backend import (
    Placement,
    RasterRequest,
    empty_statistics,
    needs_gradients,
    pixel_directions,
    place_instances,
    screen_scale,
    warm_up_requests,
)
from ..types import Instance, RenderOutput, ScreenStatistics
from .gsplat_build import load_kernels
from .gsplat_images import instance_image, median_depth_image
from .needs import kernels_for_device


@dataclass(frozen=True, eq=False)
class GsplatStatistics(ScreenStatistics):
    """Keeps gsplat's centres alive; their attribute ``absgrad`` has the absolute gradients."""

    means2d: Tensor | None = None


def track_screen(
    request: RasterRequest, meta: dict[str, Any] | None, device: torch.device
) -> ScreenStatistics:
    """Statistics on the device: radii immediately, gradients during backward.

    Args:
        meta: ``meta`` of ``gsplat.rasterization(packed=True, absgrad=True)``; None if nothing was
            drawn.
    """
    empty = empty_statistics(request, device)
    if meta is None:
        return empty
    means2d: Tensor = meta["means2d"]
    statistics = GsplatStatistics(empty.radii, empty.gradients, means2d)
    counts = torch.tensor([len(radii[0]) for radii in empty.radii], device=device)
    ends = counts.cumsum(0)
    gaussians, cameras = meta["gaussian_ids"].long(), meta["camera_ids"].long()
    owners = torch.bucketize(gaussians, ends, right=True)
    members = gaussians - (ends - counts)[owners]
    radii = meta["radii"].amax(-1).float()
    for index, held in enumerate(statistics.radii):
        mine = owners == index
        held[cameras[mine], members[mine]] = radii[mine]
    if not means2d.requires_grad:
        return statistics

    # The centres own the hook, so a strong reference would be a cycle that is never freed.
    held_weakly = weakref.ref(statistics)
    scale = torch.tensor(screen_scale(request), device=device)

    def add(gradient: Tensor) -> None:
        kept = held_weakly()
        if kept is None or kept.means2d is None:
            return
        both = torch.stack([gradient, kept.means2d.absgrad], dim=1) * scale  # type: ignore[attr-defined]
        norms = both.norm(dim=-1)
        for index, sums in enumerate(kept.gradients):
            mine = owners == index
            sums.index_add_(0, members[mine], norms[mine])

    means2d.register_hook(add)
    return statistics


# Stage times from events on the device queue


class StageTimes:
    """Times stages without waiting for each.

    On CUDA devices, device events are read after all stages have been queued. On other devices, or
    if ``waits`` is false, the times are those of queuing: training never waits.

    Args:
        device: device of the stages.
        waits: whether :meth:`read` may wait for the device.
    """

    def __init__(self, device: torch.device, *, waits: bool) -> None:
        self._device = device
        self._has_events = waits and device.type == "cuda"
        self._queued_ms: dict[str, float] = {}
        self._events: dict[str, tuple[torch.cuda.Event, torch.cuda.Event]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Context in which the stage ``name`` is queued."""
        if self._has_events:
            events = (
                torch.cuda.Event(enable_timing=True),
                torch.cuda.Event(enable_timing=True),
            )
            events[0].record(torch.cuda.current_stream(self._device))
            yield
            events[1].record(torch.cuda.current_stream(self._device))
            self._events[name] = events
            return
        start = time.perf_counter()
        yield
        self._queued_ms[name] = (time.perf_counter() - start) * 1e3

    def read(self) -> dict[str, float]:
        """Milliseconds by stage; waits for the last stage."""
        if not self._events:
            return dict(self._queued_ms)
        list(self._events.values())[-1][1].synchronize()
        return {name: first.elapsed_time(last) for name, (first, last) in self._events.items()}


# The backend


class CudaBackend:
    """Rasterizer for an NVIDIA GPU, with gsplat's gradients. Images stay on the GPU.

    Clouds on other devices are copied once and cached for their lifetime.
    """

    name = "cuda"

    def __init__(self, device: torch.device | str = "cuda") -> None:
        self.device = torch.device(device)
        kernels = kernels_for_device() if self.device.type == "cuda" else None
        if kernels is not None:
            load_kernels(kernels)
        self._resident: weakref.WeakKeyDictionary[GaussianCloud, GaussianCloud] = (
            weakref.WeakKeyDictionary()
        )

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw all cameras in one call of gsplat.rasterization."""
        options, differentiable = request.options, needs_gradients(request)
        times = StageTimes(self.device, waits=not differentiable)
        on_device = _moved(request, self.device)
        with times.stage("project"):
            world = self._world(on_device)
        with times.stage("blend"):
            rgb, alpha, depth, meta = _blend(on_device, world)
        screen = None
        if options.track_screen and differentiable:
            screen = track_screen(on_device, meta, self.device)
        instance = None
        if options.instance:
            with times.stage("instance"):
                shape = (request.cameras, request.height, request.width)
                instance = instance_image(meta, world.instance_ids, shape)
        median_depth = None
        if options.median_depth:
            with times.stage("instance"):
                shape = (request.cameras, request.height, request.width)
                median_depth = median_depth_image(meta, shape, self.device)
        with times.stage("sky"):
            rgb = rgb + (1 - alpha)[..., None] * _behind(on_device)
        return RenderOutput(
            rgb=rgb,
            alpha=alpha,
            depth=depth if options.depth else None,
            instance=instance,
            timing_ms=times.read(),
            screen=screen,
            median_depth=median_depth,
        )

    def warm_up(self) -> None:
        """Compile the instance kernel, and let gsplat reserve memory."""
        for request in warm_up_requests():
            self.rasterize(request)

    def _world(self, request: RasterRequest) -> _World:
        placement = place_instances(request.instances, request.viewmats)
        parts = [
            self._place(instance, placement, index)
            for index, instance in enumerate(request.instances)
            if len(instance.cloud)
        ]
        if not parts:
            return _World.empty(request.cameras, self.device)
        return _World(
            means=torch.cat([part.means for part in parts]),
            covars=torch.cat([part.covars for part in parts]),
            opacities=torch.cat([part.opacities for part in parts]),
            colors=torch.cat([part.colors for part in parts], dim=1),
            instance_ids=torch.cat([part.instance_ids for part in parts]),
        )

    def _place(self, instance: Instance, placement: Placement, index: int) -> _World:
        import gsplat

        cloud = self._on_device(instance.cloud)
        if instance.colour is not None:
            cloud = instance.colour.to(self.device).at(cloud, instance.t_us)
        scale = placement.scale[index]
        T = torch.eye(4, dtype=torch.float64, device=self.device)
        if instance.T_world_object is not None:
            T = torch.as_tensor(instance.T_world_object, dtype=torch.float64, device=self.device)
        linear = T[:3, :3] * scale
        seen = cloud.means * scale.float()
        colors = [
            gsplat.spherical_harmonics(cloud.sh_degree, seen - position.float(), cloud.sh)
            for position in placement.camera_position[:, index]
        ]
        covars = self._covariances(instance, cloud)
        return _World(
            means=cloud.means @ linear.float().mT + T[:3, 3].float(),
            covars=linear.float() @ covars @ linear.float().mT,
            opacities=cloud.opacities,
            colors=torch.clamp_min(torch.stack(colors) + 0.5, 0.0),
            instance_ids=torch.full(
                (len(cloud),), instance.instance_id, dtype=torch.int32, device=self.device
            ),
        )

    def _on_device(self, cloud: GaussianCloud) -> GaussianCloud:
        if cloud.device.type == self.device.type:
            return cloud
        if any(tensor.requires_grad for tensor in cloud.tensors().values()):
            return cloud.to(self.device)
        if cloud not in self._resident:
            self._resident[cloud] = cloud.to(self.device)
        return self._resident[cloud]

    def _covariances(self, instance: Instance, cloud: GaussianCloud) -> Tensor:
        import gsplat

        if instance.covars is not None:
            return instance.covars.to(self.device)
        covars: Tensor
        covars, _ = gsplat.quat_scale_to_covar_preci(
            cloud.quats, cloud.scales, compute_covar=True, compute_preci=False, triu=False
        )
        return covars


@dataclass(frozen=True, eq=False)
class _World:
    """Gaussians in the world frame: means [N, 3], covars [N, 3, 3], opacities [N], RGB colors
    [C, N, 3] as each camera sees them, instance_ids [N] int32.
    """

    means: Tensor
    covars: Tensor
    opacities: Tensor
    colors: Tensor
    instance_ids: Tensor

    @classmethod
    def empty(cls, cameras: int, device: torch.device) -> _World:
        shapes = ((0, 3), (0, 3, 3), (0,), (cameras, 0, 3))
        floats = [torch.zeros(shape, device=device) for shape in shapes]
        instance_ids = torch.zeros(0, dtype=torch.int32, device=device)
        return cls(*[*floats, instance_ids])


def _moved(request: RasterRequest, device: torch.device) -> RasterRequest:
    return replace(
        request,
        viewmats=request.viewmats.to(device),
        Ks=request.Ks.to(device),
        sky=None if request.sky is None else request.sky.to(device),
    )


def _blend(
    request: RasterRequest, world: _World
) -> tuple[Tensor, Tensor, Tensor | None, dict[str, Any] | None]:
    """RGB without background, alpha, depth, and gsplat's ``meta``."""
    options, shape = request.options, (request.cameras, request.height, request.width)
    if len(world.means) == 0:
        empty = torch.zeros(shape, device=world.means.device)
        return empty[..., None].repeat(1, 1, 1, 3), empty, empty if options.depth else None, None
    import gsplat

    images, alphas, meta = gsplat.rasterization(
        means=world.means,
        quats=None,
        scales=None,
        covars=world.covars,
        opacities=world.opacities,
        colors=world.colors,
        viewmats=request.viewmats.float(),
        Ks=request.Ks.float(),
        width=request.width,
        height=request.height,
        near_plane=options.near_plane,
        far_plane=options.far_plane,
        radius_clip=options.radius_clip,
        eps2d=options.eps2d,
        render_mode="RGB+ED" if options.depth else "RGB",
        rasterize_mode=options.rasterize_mode,
        packed=True,
        absgrad=options.track_screen,
    )
    depth = images[..., 3] if options.depth else None
    return images[..., :3], alphas[..., 0], depth, meta


def _behind(request: RasterRequest) -> Tensor:
    """Colour behind everything, [3] or [C, H, W, 3]."""
    if request.sky is None:
        return torch.tensor(request.options.background, device=request.viewmats.device)
    cameras = range(request.cameras)
    return torch.stack([request.sky.sample(pixel_directions(request, c)) for c in cameras])
