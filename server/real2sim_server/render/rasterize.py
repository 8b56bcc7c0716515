"""Rasterization of Gaussians: the rasterize() call and its batched variants."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..geometry import are_rigid, is_rotation
from ..scene import GaussianCloud, TimeColour
from .backend import Backend, BatchBackend, RasterRequest, check_optics, is_reduced
from .lens import LensView
from .select import select_backend
from .types import Detail, Instance, RasterOptions, RenderError, RenderOutput, Sky, WorldViews

DEFAULT_OPTIONS = RasterOptions()
SMALL_IMAGES = RasterOptions(depth=False, instance=False, detail="auto")
DETAILS = get_args(Detail)
UNSCALED = (1.0, 1.0, 1.0)
RASTERIZE_MODES = ("classic", "antialiased")
MAX_IMAGE_SIZE = 16_384
MAX_INSTANCE_ID = 65_535
MAX_CLASS = 255


@dataclass(frozen=True, eq=False)
class View:
    """One image of a batch.

    Attributes:
        instances: instances of its world.
        viewmat: [4, 4] ``T_camera_world``.
        K: [3, 3] intrinsics [px].
    """

    instances: Sequence[Instance]
    viewmat: ArrayLike
    K: ArrayLike


_checked: weakref.WeakSet[GaussianCloud | TimeColour] = weakref.WeakSet()


def rasterize(
    instances: Sequence[Instance],
    viewmats: Tensor | ArrayLike,
    Ks: Tensor | ArrayLike,
    width: int,
    height: int,
    *,
    sky: Sky | None = None,
    options: RasterOptions = DEFAULT_OPTIONS,
    backend: str | Backend = "auto",
    check_values: bool = True,
    between: Callable[[], object] | None = None,
    optics: LensView | None = None,
) -> RenderOutput:
    """Draw instances from C cameras of one size, with the semantics of gsplat 1.5.3.

    RGB, alpha and depth carry gradients with respect to all parts of clouds, ``covars``, object
    poses, ``viewmats`` and the faces of the sky, if these require them. The direction in which a
    pixel sees the sky, ``Ks``, ``scale`` and ``background`` are constants.

    Gaussians are projected by the local affine approximation (EWA, Zwicker et al. 2001), sorted
    by the depth of their centres (ties keep list order) and blended front to back
    (Kerbl et al. 2023). Pixel centres are at +0.5.

    Args:
        instances: clusters with their poses; the first of two at the same depth is in front.
        viewmats: [C, 4, 4] ``T_camera_world``, rigid; cameras are OpenCV (x right, y down,
            z forward).
        Ks: [C, 3, 3] intrinsics [px], without skew.
        width, height: size of all C images [px].
        sky: sky behind everything, instead of ``options.background``.
        options: planes, blur, mode and selection of images.
        backend: ``auto``, ``cpu``, ``cuda``, ``nvrtc``, ``reference``, or a Backend.
        check_values: False to skip the validation of cloud values, for callers that create new
            clouds in every call.
        between: callback between pieces of work, see RasterRequest.
        optics: lens, shutter and motion of a single camera; pass its ``optics.viewmat`` and the K
            and size of its camera. With optics, Gaussians are evaluated at their maximum along
            each pixel's ray (Moenne-Loccoz et al. 2024) instead of being projected, and depths are
            ranges if the camera defines them so.

    Raises:
        RenderError: for invalid arguments and for optics that the backend cannot draw; nothing is
            drawn.
    """
    request = checked_request(
        instances,
        viewmats,
        Ks,
        (width, height),
        sky=sky,
        options=options,
        check_values=check_values,
        between=between,
        optics=optics,
    )
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    check_optics(chosen, request)
    return chosen.rasterize(request)


def checked_request(
    instances: Sequence[Instance],
    viewmats: Tensor | ArrayLike,
    Ks: Tensor | ArrayLike,
    size: tuple[int, int],
    *,
    sky: Sky | None = None,
    options: RasterOptions = DEFAULT_OPTIONS,
    check_values: bool = True,
    between: Callable[[], object] | None = None,
    optics: LensView | None = None,
) -> RasterRequest:
    """Validate the arguments of :func:`rasterize` for a backend; ``size`` is (width, height).

    Raises:
        RenderError: as :func:`rasterize`.
    """
    request = RasterRequest(
        instances=tuple(instances),
        viewmats=_float64(viewmats, "viewmats", (4, 4)),
        Ks=_float64(Ks, "Ks", (3, 3)),
        width=size[0],
        height=size[1],
        sky=sky,
        options=options,
        optics=optics,
        between=between,
    )
    _check_request(request, check_values=check_values)
    return request


def rasterize_batch(
    views: Sequence[View],
    width: int,
    height: int,
    *,
    sky: Sky | None = None,
    options: RasterOptions = SMALL_IMAGES,
    backend: str | Backend = "auto",
) -> RenderOutput:
    """Draw the images of many worlds in one call, in the order of ``views``.

    Backends that support it draw small images in parallel, each on one core. Every image is bitwise
    equal to that of :func:`rasterize`. Images carry no gradients.

    Args:
        views: instances and camera of each image; at least one.
        width, height: size of all images [px].
        sky: sky behind everything.
        options: options of all images; by default small ones are drawn from merged Gaussians.
        backend: see :func:`rasterize`.

    Raises:
        RenderError: see :func:`rasterize`; also for an empty list of views.
    """
    if not views:
        raise RenderError("rasterize_batch() needs at least one view")
    viewmats = _float64(np.stack([view.viewmat for view in views]), "viewmats", (4, 4))
    Ks = _float64(np.stack([view.K for view in views]), "Ks", (3, 3))
    everything = RasterRequest(
        instances=tuple(instance for view in views for instance in view.instances),
        viewmats=viewmats,
        Ks=Ks,
        width=width,
        height=height,
        sky=sky,
        options=options,
    )
    _check_request(everything, check_values=True)
    requests = [
        replace(
            everything,
            instances=tuple(view.instances),
            viewmats=viewmats[k : k + 1],
            Ks=Ks[k : k + 1],
        )
        for k, view in enumerate(views)
    ]
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    with torch.no_grad():
        if isinstance(chosen, BatchBackend) and is_reduced(everything):
            return chosen.rasterize_batch(requests)
        return _joined([chosen.rasterize(request) for request in requests])


def rasterize_worlds(
    worlds: WorldViews,
    width: int,
    height: int,
    *,
    sky: Sky | None = None,
    options: RasterOptions = SMALL_IMAGES,
    backend: str | Backend = "auto",
) -> RenderOutput:
    """Draw many worlds with the same instances: [W C] images, by world, then by camera.

    The images are bitwise equal to those of :func:`rasterize_batch`. Backends that support it
    prepare instances once for all small images instead of once per image.

    Args:
        worlds: at least one world and one camera.
        width, height: size of all images [px].
        sky, options, backend: see :func:`rasterize_batch`.

    Raises:
        RenderError: see :func:`rasterize_batch`.
    """
    like = RasterRequest(
        instances=worlds.things,
        viewmats=_float64(worlds.viewmats.reshape(-1, 4, 4)[:1], "viewmats", (4, 4)),
        Ks=_float64(worlds.Ks[:1], "Ks", (3, 3)),
        width=width,
        height=height,
        sky=sky,
        options=options,
    )
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    with torch.no_grad():
        if isinstance(chosen, BatchBackend) and is_reduced(like):
            _check_worlds(worlds, like)
            return chosen.rasterize_worlds(worlds, like)
    views = views_of(worlds)
    return rasterize_batch(views, width, height, sky=sky, options=options, backend=chosen)


def views_of(worlds: WorldViews) -> list[View]:
    """A View for each image of ``worlds``."""
    views = []
    for w, viewmats in enumerate(worlds.viewmats):
        t_us = int(worlds.times_us[w])
        instances = [
            replace(worlds.things[k], T_world_object=worlds.poses[w, k], t_us=t_us)
            for k in np.flatnonzero(worlds.shown[w]).tolist()
        ]
        views += [View(instances, *camera) for camera in zip(viewmats, worlds.Ks, strict=True)]
    return views


def _check_worlds(worlds: WorldViews, like: RasterRequest) -> None:
    """Validate instances and cameras like any request, and the poses of shown instances."""
    _check_request(like, check_values=True)
    viewmats = _float64(worlds.viewmats.reshape(-1, 4, 4), "viewmats", (4, 4))
    _check_cameras(
        replace(
            like, viewmats=viewmats, Ks=torch.from_numpy(worlds.Ks).tile(len(worlds.viewmats), 1, 1)
        )
    )
    poses = worlds.poses[worlds.shown]
    if not are_rigid(poses).all():
        for place, pose in zip(np.argwhere(worlds.shown).tolist(), poses, strict=True):
            _check_rigid(pose, f"poses{place}")


def _joined(outputs: Sequence[RenderOutput]) -> RenderOutput:
    """Join the images of several calls."""
    timing: dict[str, float] = {}
    for output in outputs:
        for stage, milliseconds in output.timing_ms.items():
            timing[stage] = timing.get(stage, 0.0) + milliseconds
    depths = [output.depth for output in outputs if output.depth is not None]
    instances = [output.instance for output in outputs if output.instance is not None]
    medians = [output.median_depth for output in outputs if output.median_depth is not None]
    return RenderOutput(
        rgb=torch.cat([output.rgb for output in outputs]),
        alpha=torch.cat([output.alpha for output in outputs]),
        depth=torch.cat(depths) if depths else None,
        instance=torch.cat(instances) if instances else None,
        timing_ms=timing,
        median_depth=torch.cat(medians) if medians else None,
    )


def _check_request(request: RasterRequest, *, check_values: bool) -> None:
    _check_cameras(request)
    if request.optics is not None:
        _check_optics(request.optics, request)
    _check_options(request.options)
    _check_poses(request.instances, trusted=not check_values)
    for index, instance in enumerate(request.instances):
        _check_instance(index, instance, check_values=check_values)


def _float64(values: Tensor | ArrayLike, name: str, matrix: tuple[int, int]) -> Tensor:
    tensor = torch.as_tensor(values, dtype=torch.float64)
    if tensor.ndim != 3 or tuple(tensor.shape[1:]) != matrix:
        raise RenderError(f"{name} must be [C, {matrix[0]}, {matrix[1]}], not {list(tensor.shape)}")
    if not torch.isfinite(tensor).all():
        raise RenderError(f"{name} hold values that are not finite")
    return tensor


def _check_cameras(request: RasterRequest) -> None:
    if request.Ks.requires_grad:
        raise RenderError("Ks carry no gradient here; give them without requires_grad")
    if len(request.Ks) != request.cameras:
        raise RenderError(f"{request.cameras} viewmats but {len(request.Ks)} Ks; give one each")
    for name, size in (("width", request.width), ("height", request.height)):
        if not 1 <= size <= MAX_IMAGE_SIZE:
            raise RenderError(f"{name} must be 1 to {MAX_IMAGE_SIZE} px, not {size!r}")
    poses, Ks = (given.detach().cpu().numpy() for given in (request.viewmats, request.Ks))
    if not are_rigid(poses).all():
        for index, pose in enumerate(poses):
            _check_rigid(pose, f"viewmats[{index}]")
    for index, K in enumerate(Ks):
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise RenderError(f"Ks[{index}] must have positive focal lengths, not {K.tolist()}")
        if K[0, 1] != 0 or K[1, 0] != 0 or not np.array_equal(K[2], (0, 0, 1)):
            raise RenderError(
                f"Ks[{index}] must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], not {K.tolist()}"
            )


def _check_optics(optics: LensView, request: RasterRequest) -> None:
    """Check that there is one camera, consistent with the optics."""
    camera = optics.camera
    for name, pose in (("start", optics.motion.start), ("end", optics.motion.end)):
        _check_rigid(pose, f"optics.motion.{name}")
    given = request.viewmats.detach().cpu().numpy(), request.Ks.detach().cpu().numpy()
    same = (camera.width, camera.height) == (request.width, request.height)
    same = same and request.cameras == 1 and np.array_equal(given[1][0], camera.K)
    if not (same and np.allclose(given[0][0], optics.viewmat, atol=1e-9)):
        raise RenderError(
            f"optics require one camera, {camera.name!r} of {camera.width}x{camera.height}, whose "
            "K and viewmat at mid-readout equal the given ones"
        )
    for index, instance in enumerate(request.instances):
        twist = instance.twist
        if twist is not None and (twist.shape != (6,) or not np.isfinite(twist).all()):
            raise RenderError(f"instances[{index}].twist must be six finite numbers")


def _values(matrix: Tensor | ArrayLike) -> np.ndarray:
    return matrix.detach().cpu().numpy() if isinstance(matrix, Tensor) else np.asarray(matrix)


def _check_rigid(matrix: np.ndarray, name: str) -> None:
    if matrix.shape != (4, 4):
        raise RenderError(f"{name} must be [4, 4], not {list(matrix.shape)}")
    bottom = np.array_equal(matrix[3], (0, 0, 0, 1))
    if not np.isfinite(matrix).all() or not bottom or not is_rotation(matrix[:3, :3]):
        raise RenderError(f"{name} must be a rigid transform, not {matrix.tolist()}")


def _check_poses(instances: Sequence[Instance], *, trusted: bool) -> None:
    """Validate the poses of all instances at once; search for the invalid one on failure.

    Skips poses of trusted callers on another device, to avoid waiting for it.
    """
    poses = {
        f"instances[{index}].T_world_object": _values(instance.T_world_object)
        for index, instance in enumerate(instances)
        if instance.T_world_object is not None
        and not (trusted and _on_other_device(instance.T_world_object))
    }
    shaped = all(pose.shape == (4, 4) for pose in poses.values())
    if poses and not (shaped and are_rigid(np.stack(list(poses.values()))).all()):
        for name, pose in poses.items():
            _check_rigid(pose, name)


def _on_other_device(matrix: Tensor | ArrayLike) -> bool:
    return isinstance(matrix, Tensor) and matrix.device.type != "cpu"


def _check_options(options: RasterOptions) -> None:
    if options.detail not in DETAILS:
        raise RenderError(f"detail must be one of {list(DETAILS)}, not {options.detail!r}")
    if options.rasterize_mode not in RASTERIZE_MODES:
        raise RenderError(
            f"rasterize_mode must be one of {list(RASTERIZE_MODES)}, not {options.rasterize_mode!r}"
        )
    if not 0 < options.near_plane < options.far_plane:
        raise RenderError(
            "near_plane and far_plane must be positive and increase, "
            f"not {options.near_plane!r} and {options.far_plane!r}"
        )
    for name in ("eps2d", "radius_clip"):
        if not 0 <= getattr(options, name) < np.inf:
            raise RenderError(f"{name} must be finite and >= 0, not {getattr(options, name)!r}")
    if not np.isfinite(options.background).all() or len(options.background) != 3:
        raise RenderError(f"background must be three finite numbers, not {options.background!r}")


def _check_instance(index: int, instance: Instance, *, check_values: bool) -> None:
    name = f"instances[{index}]"
    if not 0 <= instance.semantic <= MAX_CLASS:
        raise RenderError(f"{name}.semantic must be 0 to {MAX_CLASS}, not {instance.semantic!r}")
    if not 0 <= instance.instance_id <= MAX_INSTANCE_ID:
        raise RenderError(
            f"{name}.instance_id must be 0 to {MAX_INSTANCE_ID}, not {instance.instance_id!r}"
        )
    if instance.scale != UNSCALED and not _is_scale(instance.scale):
        raise RenderError(f"{name}.scale must be three positive numbers, not {instance.scale!r}")
    if instance.covars is not None:
        expected = (len(instance.cloud), 3, 3)
        if tuple(instance.covars.shape) != expected or instance.covars.dtype != torch.float32:
            raise RenderError(
                f"{name}.covars must be {list(expected)} float32, "
                f"not {list(instance.covars.shape)} {instance.covars.dtype}"
            )
        if not torch.isfinite(instance.covars).all():
            raise RenderError(f"{name}.covars hold values that are not finite")
    if check_values and instance.cloud not in _checked:
        _check_cloud(instance.cloud, f"{name}.cloud")
        _checked.add(instance.cloud)
    if instance.colour is not None:
        _check_colour(instance.colour, len(instance.cloud), f"{name}.colour")


def _is_scale(scale: tuple[float, float, float]) -> bool:
    values = np.asarray(scale, dtype=np.float64)
    return values.shape == (3,) and bool(np.isfinite(values).all() and (values > 0).all())


def _check_cloud(cloud: GaussianCloud, name: str) -> None:
    """Validate the values of a cloud; cached, because clouds are immutable."""
    for part in ("means", "quats", "scales", "opacities", "sh"):
        values = getattr(cloud, part).detach()
        if torch.isfinite(values.sum()):
            continue
        finite = torch.isfinite(values)
        if not finite.all():
            row = int((~finite).reshape(len(cloud), -1).any(1).nonzero()[0])
            raise RenderError(f"{name}.{part} of Gaussian {row} is not finite; drop it first")
    if len(cloud) == 0:
        return
    if cloud.scales.detach().amin() < 0:
        raise RenderError(f"{name}.scales must be linear and >= 0; were logarithms given?")
    low, high = cloud.opacities.detach().aminmax()
    if low < 0 or high > 1:
        raise RenderError(f"{name}.opacities must be in [0, 1]; are they logits?")


def _check_colour(colour: TimeColour, gaussians: int, name: str) -> None:
    """Validate a colour against its cloud; value checks are cached: colours are immutable."""
    rows = len(colour.coefficients)
    if rows != gaussians:
        raise RenderError(f"{name} has {rows} rows for a cloud of {gaussians} Gaussians")
    if colour not in _checked:
        if not torch.isfinite(colour.coefficients).all():
            raise RenderError(f"{name}.coefficients hold values that are not finite")
        _checked.add(colour)
