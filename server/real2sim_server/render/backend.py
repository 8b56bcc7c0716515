"""The interface of rasterizer backends: requests, results, and what several backends share."""

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
"""No single Gaussian covers a pixel more than this, so that transmittance stays above 0."""
ALPHA_MIN = 1.0 / 255.0
"""Contributions below this are skipped; it also bounds the extent of a Gaussian on screen."""
TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished when the next Gaussian would bring its transmittance to this or below."""
CLAMP_MARGIN = 0.3
"""x/z and y/z of the projection Jacobian may leave the image by this times tan(fov / 2)."""


@dataclass(frozen=True, eq=False)
class RasterRequest:
    """A checked rasterize() call.

    Attributes:
        instances: what is drawn; order breaks ties of depth.
        viewmats: [C, 4, 4] float64 torch, ``T_camera_world``.
        Ks: [C, 3, 3] float64 torch [px].
        width, height: size of all images [px].
        sky: what is seen behind everything, or None for ``options.background``.
        options: the rest.
        optics: lens, shutter and motion of the only camera, whose viewmat is that of the middle of
            the read-out; None for pinholes.
        between: called between pieces of the work, each of some 10 ms, on the calling thread. It
            may rasterize something else with the same backend. None: the work is done in one go.
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
    """Whether the pictures must carry gradients to anything in the request."""
    if not torch.is_grad_enabled():
        return False
    tensors: list[object] = [request.viewmats, request.sky.faces if request.sky else None]
    for instance in request.instances:
        tensors += [*vars(instance.cloud).values(), instance.T_world_object, instance.covars]
        tensors += [instance.colour.coefficients] if instance.colour else []
    return any(isinstance(tensor, Tensor) and tensor.requires_grad for tensor in tensors)


def is_reduced(request: RasterRequest) -> bool:
    """Whether a backend that can merge Gaussians does so for this request."""
    small = request.width * request.height <= SMALL_IMAGE_PIXELS
    plain = request.optics is None
    return plain and request.options.detail == "auto" and small and not needs_gradients(request)


def class_behind(request: RasterRequest) -> int:
    """Class of pixels in which nothing takes half of the light."""
    return UNLABELED if request.sky is None else SKY


def with_colours(request: RasterRequest) -> RasterRequest:
    """The request with colours that change over time put into the clouds."""
    instances = tuple(
        i if i.colour is None else replace(i, cloud=i.colour.at(i.cloud, i.t_us), colour=None)
        for i in request.instances
    )
    return replace(request, instances=instances)


class Backend(Protocol):
    """One way to rasterize. All members give the same pictures within 1/255.

    A member that draws lenses and rolling shutters has ``draws_lenses = True``.
    """

    name: str

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw the request. Images lie on the device the backend works on."""
        ...

    def warm_up(self) -> None:
        """Compile or load whatever the first call would otherwise wait for."""
        ...


@runtime_checkable
class BatchBackend(Protocol):
    """A Backend that draws the small images of many requests in one go."""

    def rasterize_batch(self, requests: Sequence[RasterRequest]) -> RenderOutput:
        """All images of ``requests``, which are of one size, one sky and the same options, and for
        each of which :func:`is_reduced` holds; the same bits as one by one."""
        ...

    def rasterize_worlds(self, worlds: WorldViews, like: RasterRequest) -> RenderOutput:
        """All images of ``worlds``, by world and then by camera; sizes, sky and options are those
        of ``like``, for which :func:`is_reduced` holds. The same bits as one by one."""
        ...


@dataclass(frozen=True, eq=False)
class StartedFrames:
    """Images on their way to the host.

    Attributes:
        images: [C, H, W, ...] by modality of each request, on the host; whole once ``ready`` has
            returned.
        ready: waits for them; on any thread, any number of times.
    """

    images: list[dict[str, NDArray[Any]]]
    ready: Callable[[], object]


@runtime_checkable
class FrameBackend(Protocol):
    """A Backend that draws images of several sizes in one go, as they leave the renderer."""

    @property
    def modalities(self) -> frozenset[str]:
        """Those of which :meth:`frames` makes images."""
        ...

    def frames(
        self, requests: Sequence[RasterRequest], modalities: Sequence[str]
    ) -> list[dict[str, NDArray[Any]]]:
        """Images [C, H, W, ...] by modality of each request, on the host and for the caller to
        keep; what the modality's ``pixels`` makes of :meth:`Backend.rasterize`, within one level
        of a byte."""
        ...

    def start_frames(
        self, requests: Sequence[RasterRequest], modalities: Sequence[str]
    ) -> StartedFrames:
        """As :meth:`frames`, but returns when they are drawn: the next ones are drawn while they
        are copied."""
        ...


def draws_lens(backend: Backend) -> bool:
    """Whether ``backend`` draws lenses and rolling shutters."""
    return bool(getattr(backend, "draws_lenses", False))


def no_lens(backend: Backend, camera: Camera) -> str:
    """Why ``backend`` does not draw a camera, and what to do."""
    kind = "pinhole" if camera.lens is None else camera.lens.model
    return (
        f"the backend {backend.name!r} draws pinhole cameras with a global shutter, not camera "
        f"{camera.name!r} ({kind}, shutter {camera.shutter.direction}); use the backend 'cpu', or "
        "ask for the pinhole image"
    )


def check_optics(backend: Backend, request: RasterRequest) -> None:
    """Raises RenderError where ``backend`` cannot draw the request's lens or shutter."""
    if request.optics is not None and not draws_lens(backend):
        raise RenderError(no_lens(backend, request.optics.camera))


def device_of(backend: Backend) -> torch.device:
    """Where the images of ``backend`` lie, and where its inputs are best kept."""
    device: torch.device = getattr(backend, "device", torch.device("cpu"))
    return device


@dataclass(frozen=True, eq=False)
class Placement:
    """Where I instances stand before C cameras; float64, so that only the result is rounded.

    Attributes:
        linear: [C, I, 3, 3] maps cloud coordinates to the camera frame, scale included.
        offset: [C, I, 3] position of the clouds' origins in the camera frame [m].
        camera_position: [C, I, 3] camera centre in the instance's unscaled frame [m]; colours
            are seen along ``scale * mean - camera_position``.
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
    """Factors on gradients by x and y [px]; see ScreenStatistics."""
    return request.cameras * request.width / 2, request.cameras * request.height / 2


class ScreenTracker:
    """Fills ScreenStatistics for the reference."""

    def __init__(self, request: RasterRequest) -> None:
        self.statistics = empty_statistics(request)
        self._scale = torch.tensor(screen_scale(request), dtype=torch.float64)
        self._size = torch.tensor([request.width, request.height])

    def watch(
        self, camera: int, owners: Tensor, means2d: Tensor, extents: Tensor
    ) -> ScreenWatch | None:
        """Note the radii of V splats of one camera and listen for the gradients of their centres.

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
    """Sums over pixels of absolute gradients [V, 2] by the centres of V splats of one camera."""

    def __init__(self, count: int) -> None:
        self.absolute = torch.zeros(count, 2, dtype=torch.float64)

    def gather(self, index: Tensor, dx: Tensor, dy: Tensor) -> None:
        """Listen to offsets [M, pixels] from the splats ``index`` [M] to the pixels of a tile."""
        for axis, offsets in enumerate((dx, dy)):
            if offsets.requires_grad:
                offsets.register_hook(functools.partial(self._add, axis, index))

    def _add(self, axis: int, index: Tensor, gradient: Tensor) -> None:
        self.absolute[:, axis].index_add_(0, index, gradient.abs().sum(1).double())


# Warm-up: small requests that together use every path of a backend

MANY = 5_000
"""More Gaussians than a backend treats as one block."""


def warm_up_requests() -> Iterator[RasterRequest]:
    """One request for each combination that could be compiled on its own."""
    yield from picture_requests()
    yield from small_requests()


def picture_requests() -> Iterator[RasterRequest]:
    """Those of a scene's first picture, which shows clouds of many Gaussians."""
    for labels in (False, True):
        yield _request(_cloud(MANY), labels=labels)


def small_requests() -> Iterator[RasterRequest]:
    """Those of clouds of few Gaussians, and of small images, for which Gaussians are merged."""
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
    """A cloud of this many Gaussians, at two places in front of the camera."""
    two = GaussianCloud(
        means=torch.tensor([[0.0, 0, 2], [0, 0, 3]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        scales=torch.full((2, 3), 0.1),
        opacities=torch.full((2,), 0.5),
        sh=torch.zeros(2, 16, 3),
    )
    return two.select(torch.arange(count) % 2)
