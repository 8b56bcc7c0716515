"""What every rasterizer backend takes and gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from numpy.typing import NDArray
from torch import Tensor

from real2sim_proto.semantics import SKY, UNLABELED

from ...scene import Camera
from ..lens_view import LensView
from ..types import (
    SMALL_IMAGE_PIXELS,
    Instance,
    RasterOptions,
    RenderError,
    RenderOutput,
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
