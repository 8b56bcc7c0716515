"""The interface of rasterizer backends: requests, results and shared helpers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from real2sim_proto.conventions import SKY, UNLABELED

from ..scene import Camera, GaussianCloud
from .lens import LensView
from .types import (
    SMALL_IMAGE_PIXELS,
    Detail,
    Instance,
    RasterOptions,
    RenderError,
    RenderOutput,
    ScreenStatistics,
    Sky,
    WorldViews,
)

ALPHA_MAX = 0.999
"""Maximum alpha of a Gaussian at a pixel, so that transmittance stays above 0."""
ALPHA_MIN = 1.0 / 255.0
"""Contributions below this are skipped; it also bounds the extent of a Gaussian on screen."""
TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished when the next Gaussian would bring its transmittance to this or below."""
CLAMP_MARGIN = 0.3
"""Margin around the image for x/z and y/z in the Jacobian, in units of tan(fov / 2)."""


@dataclass(frozen=True, eq=False)
class RasterRequest:
    """A validated rasterize() call.

    Attributes:
        instances: instances to draw; list order breaks depth ties.
        viewmats: [C, 4, 4] float64 torch, ``T_camera_world``.
        Ks: [C, 3, 3] float64 torch [px].
        width, height: size of all images [px].
        sky: sky behind everything, or None for ``options.background``.
        options: all other options.
        optics: lens, shutter and motion of a single camera, whose viewmat is that at mid-readout;
            None for pinhole cameras.
        between: callback between pieces of work of about 10 ms each, on the calling thread. It may
            rasterize with the same backend. If None, the work is not interrupted.
    """

    instances: tuple[Instance, ...]
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    sky: Sky | None
    options: RasterOptions
    optics: LensView | None = None
    between: Callable[[], object] | None = None

    @property
    def cameras(self) -> int:
        """Number of cameras C."""
        return int(self.viewmats.shape[0])


def needs_gradients(request: RasterRequest) -> bool:
    """Whether images must carry gradients to any input of the request."""
    if not torch.is_grad_enabled():
        return False
    tensors: list[object] = [request.viewmats, request.sky.faces if request.sky else None]
    for instance in request.instances:
        tensors += [*vars(instance.cloud).values(), instance.T_world_object, instance.covars]
        tensors += [instance.colour.coefficients] if instance.colour else []
    return any(isinstance(tensor, Tensor) and tensor.requires_grad for tensor in tensors)


def is_reduced(request: RasterRequest) -> bool:
    """Whether a backend with levels of detail merges Gaussians for this request."""
    small = request.width * request.height <= SMALL_IMAGE_PIXELS
    plain = request.optics is None
    return plain and request.options.detail == "auto" and small and not needs_gradients(request)


def class_behind(request: RasterRequest) -> int:
    """Semantic class of pixels with an opacity below one half."""
    return UNLABELED if request.sky is None else SKY


def with_colours(request: RasterRequest) -> RasterRequest:
    """The request with time-dependent colours evaluated and stored in the clouds."""
    instances = tuple(
        i if i.colour is None else replace(i, cloud=i.colour.at(i.cloud, i.t_us), colour=None)
        for i in request.instances
    )
    return replace(request, instances=instances)


class Backend(Protocol):
    """A rasterizer. All backends give the same images within 1/255.

    Backends that support lenses and rolling shutters set ``draws_lenses = True``.
    """

    name: str

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw the request. Images are on the backend's device."""
        ...

    def warm_up(self) -> None:
        """Compile or load everything that the first call needs."""
        ...


@runtime_checkable
class BatchBackend(Protocol):
    """A Backend that draws the small images of many requests in one call."""

    def rasterize_batch(self, requests: Sequence[RasterRequest]) -> RenderOutput:
        """All images of ``requests``; bitwise equal to separate calls.

        Requests must share size, sky and options, and satisfy :func:`is_reduced`.
        """
        ...

    def rasterize_worlds(self, worlds: WorldViews, like: RasterRequest) -> RenderOutput:
        """All images of ``worlds``, by world, then by camera; bitwise equal to separate calls.

        Size, sky and options are those of ``like``, which must satisfy :func:`is_reduced`.
        """
        ...


@dataclass(frozen=True, eq=False)
class StartedFrames:
    """Images that are being copied to the host.

    Attributes:
        images: [C, H, W, ...] by modality of each request, on the host; complete once ``ready``
            has returned.
        ready: waits for the images; thread-safe, can be called repeatedly.
    """

    images: list[dict[str, NDArray[Any]]]
    ready: Callable[[], object]


@runtime_checkable
class FrameBackend(Protocol):
    """A Backend that draws final images of several sizes in one call."""

    @property
    def modalities(self) -> frozenset[str]:
        """Modalities that :meth:`frames` supports."""
        ...

    def frames(
        self, requests: Sequence[RasterRequest], modalities: Sequence[str]
    ) -> list[dict[str, NDArray[Any]]]:
        """Images [C, H, W, ...] by modality of each request, on the host, owned by the caller.

        Equal to the modality's ``pixels`` of :meth:`Backend.rasterize` within one byte level.
        """
        ...

    def start_frames(
        self, requests: Sequence[RasterRequest], modalities: Sequence[str]
    ) -> StartedFrames:
        """Like :meth:`frames`, but returns before the copy to the host is complete."""
        ...


def draws_lens(backend: Backend) -> bool:
    """Whether ``backend`` supports lenses and rolling shutters."""
    return bool(getattr(backend, "draws_lenses", False))


def no_lens(backend: Backend, camera: Camera) -> str:
    """Error message that ``backend`` cannot draw a camera, with a suggestion."""
    kind = "pinhole" if camera.lens is None else camera.lens.model
    return (
        f"the backend {backend.name!r} draws pinhole cameras with a global shutter, not camera "
        f"{camera.name!r} ({kind}, shutter {camera.shutter.direction}); use the backend 'cpu', or "
        "ask for the pinhole image"
    )


def check_optics(backend: Backend, request: RasterRequest) -> None:
    """Raise RenderError if ``backend`` cannot draw the request's lens or shutter."""
    if request.optics is not None and not draws_lens(backend):
        raise RenderError(no_lens(backend, request.optics.camera))


def device_of(backend: Backend) -> torch.device:
    """Device of the images of ``backend``, and the preferred device of its inputs."""
    device: torch.device = getattr(backend, "device", torch.device("cpu"))
    return device


@dataclass(frozen=True, eq=False)
class Placement:
    """Poses of I instances relative to C cameras; float64, so that only the result is rounded.

    Attributes:
        linear: [C, I, 3, 3] maps cloud coordinates to the camera frame, including scale.
        offset: [C, I, 3] origins of the clouds, camera frame [m].
        camera_position: [C, I, 3] camera centre in the instance's unscaled frame [m]; the view
            direction of a colour is ``scale * mean - camera_position``.
        scale: [I, 3].
    """

    linear: Tensor
    offset: Tensor
    camera_position: Tensor
    scale: Tensor


def place_instances(instances: Sequence[Instance], viewmats: Tensor) -> Placement:
    """Compose ``viewmats`` [C, 4, 4] float64 with the pose and scale of each instance."""
    dtype, device = torch.float64, viewmats.device
    identity = torch.eye(4, dtype=dtype, device=device)
    poses = [
        identity
        if i.T_world_object is None
        else torch.as_tensor(i.T_world_object, dtype=dtype, device=device)
        for i in instances
    ]
    T_world_object = (
        torch.stack(poses) if poses else torch.zeros(0, 4, 4, dtype=dtype, device=device)
    )
    scale = torch.tensor([i.scale for i in instances], dtype=dtype, device=device).reshape(-1, 3)
    T_camera_object = viewmats[:, None] @ T_world_object[None]
    rotation, offset = T_camera_object[..., :3, :3], T_camera_object[..., :3, 3]
    camera_position = -(rotation.mT @ offset[..., None])[..., 0]
    return Placement(rotation * scale[None, :, None, :], offset, camera_position, scale)


def direction_matrix(request: RasterRequest, camera: int) -> Tensor:
    """``R_world_camera K^-1`` [3, 3] float32: maps (x, y, 1) [px] to a world direction."""
    rotation = request.viewmats[camera, :3, :3].detach()
    inverse: Tensor = torch.linalg.inv(request.Ks[camera])
    return (rotation.mT @ inverse).float()


def pixel_directions(request: RasterRequest, camera: int) -> Tensor:
    """World directions [H, W, 3] float32 of pixel centres, on the device of ``viewmats``."""
    matrix = direction_matrix(request, camera)
    x = torch.arange(request.width, device=matrix.device) + 0.5
    y = torch.arange(request.height, device=matrix.device) + 0.5
    return (x[None, :, None] * matrix[:, 0] + y[:, None, None] * matrix[:, 1]) + matrix[:, 2]


# Screen statistics from torch hooks


def empty_statistics(
    request: RasterRequest, device: torch.device | str = "cpu"
) -> ScreenStatistics:
    """Zeros for every Gaussian of every instance."""
    counts = [len(instance.cloud) for instance in request.instances]
    return ScreenStatistics(
        radii=tuple(torch.zeros(request.cameras, n, device=device) for n in counts),
        gradients=tuple(torch.zeros(n, 2, device=device) for n in counts),
    )


def screen_scale(request: RasterRequest) -> tuple[float, float]:
    """Scale factors of gradients with respect to x and y [px]; see ScreenStatistics."""
    return request.cameras * request.width / 2, request.cameras * request.height / 2


class ScreenTracker:
    """Collects ScreenStatistics for the reference backend."""

    def __init__(self, request: RasterRequest) -> None:
        self.statistics = empty_statistics(request)
        self._scale = torch.tensor(screen_scale(request), dtype=torch.float64)
        self._size = torch.tensor([request.width, request.height])

    def watch(
        self, camera: int, owners: Tensor, means2d: Tensor, extents: Tensor
    ) -> ScreenWatch | None:
        """Record the radii of V splats of one camera and hook the gradients of their centres.

        Args:
            camera: index of the camera.
            owners: [V, 2] int64, instance and Gaussian of each splat.
            means2d: [V, 2] centres [px].
            extents: [V, 2] half the sides of their boxes [px].
        """
        centres = means2d.detach()
        seen = ((centres + extents > 0) & (centres - extents < self._size)).all(-1)
        radii = torch.where(seen, extents.amax(-1).ceil(), 0.0).float()
        for index, held in enumerate(self.statistics.radii):
            mine = owners[:, 0] == index
            held[camera, owners[mine, 1]] = radii[mine]
        if not means2d.requires_grad:
            return None
        watch = ScreenWatch(len(owners))
        means2d.register_hook(lambda gradient: self._add(owners, gradient, watch))
        return watch

    def _add(self, owners: Tensor, gradient: Tensor, watch: ScreenWatch) -> None:
        both = torch.stack([gradient, watch.absolute], dim=1) * self._scale
        norms = both.norm(dim=-1).float()
        watch.absolute.zero_()
        for index, held in enumerate(self.statistics.gradients):
            mine = owners[:, 0] == index
            held[owners[mine, 1]] += norms[mine]


class ScreenWatch:
    """Sums over pixels of absolute gradients [V, 2] of the centres of V splats of one camera."""

    def __init__(self, count: int) -> None:
        self.absolute = torch.zeros(count, 2, dtype=torch.float64)

    def gather(self, index: Tensor, dx: Tensor, dy: Tensor) -> None:
        """Hook offsets [M, pixels] from the splats ``index`` [M] to the pixels of a tile."""
        for axis, offsets in enumerate((dx, dy)):
            if offsets.requires_grad:
                offsets.register_hook(functools.partial(self._add, axis, index))

    def _add(self, axis: int, index: Tensor, gradient: Tensor) -> None:
        self.absolute[:, axis].index_add_(0, index, gradient.abs().sum(1).double())


# Warm-up: small requests that together cover every path of a backend

MANY = 5_000
"""Number of Gaussians that exceeds a block of any backend."""


def warm_up_requests() -> Iterator[RasterRequest]:
    """One request for each separately compiled combination."""
    yield from picture_requests()
    yield from small_requests()


def picture_requests() -> Iterator[RasterRequest]:
    """Requests that cover the first image of a scene, with clouds of many Gaussians."""
    for labels in (False, True):
        yield _request(_cloud(MANY), labels=labels)


def small_requests() -> Iterator[RasterRequest]:
    """Requests that cover clouds of few Gaussians, and small images with merged Gaussians."""
    details: tuple[Detail, ...] = ("full", "auto")
    for detail in details:
        yield _request(_cloud(2), _cloud(MANY), labels=True, detail=detail)


def _request(
    placed: GaussianCloud, *others: GaussianCloud, labels: bool, detail: Detail = "full"
) -> RasterRequest:
    covars = (0.01 * torch.eye(3)).repeat(len(placed), 1, 1)
    K = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]], dtype=torch.float64)
    return RasterRequest(
        instances=(
            *map(Instance, (placed, *others)),
            Instance(placed, T_world_object=np.eye(4), instance_id=1, covars=covars),
        ),
        viewmats=torch.eye(4, dtype=torch.float64)[None],
        Ks=K,
        width=16,
        height=16,
        sky=Sky.uniform((0.5, 0.6, 0.7)),
        options=RasterOptions(depth=labels, instance=labels, detail=detail),
    )


def _cloud(count: int) -> GaussianCloud:
    """A cloud of ``count`` Gaussians, at two positions in front of the camera."""
    two = GaussianCloud(
        means=torch.tensor([[0.0, 0, 2], [0, 0, 3]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        scales=torch.full((2, 3), 0.1),
        opacities=torch.full((2,), 0.5),
        sh=torch.zeros(2, 16, 3),
    )
    return two.select(torch.arange(count) % 2)
