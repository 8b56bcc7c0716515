"""Images of a vehicle's cameras at one instant, with lenses, labels and uncertainty."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import repeat
from typing import Any, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from real2sim_proto.conventions import UNLABELED

from .._numba import is_on_disk, made
from ..scene import UNSEEN, BrownConrady, Camera, CameraMotion, GaussianCloud, Shutter
from ..scene.cloud import SH_C0
from .backend import (
    Backend,
    BatchBackend,
    FrameBackend,
    RasterRequest,
    check_optics,
    class_behind,
    draws_lens,
    is_reduced,
    no_lens,
)
from .images import to_uint8
from .lens import LensView, tables_of
from .modalities import modalities_drawn, modality_of, options_for
from .rasterize import DEFAULT_OPTIONS, MAX_INSTANCE_ID, checked_request
from .select import select_backend
from .types import Instance, LabelOutput, RasterOptions, RenderError, RenderOutput, Sky, Window

# Uncertainty is a pass with uncertainties instead of colours. A pixel is the mean over its
# Gaussians, weighted by their contribution. Merged Gaussians of small images have the mean of their
# members. Backends treat it as a colour.

UNCERTAINTY = "uncertainty"
"""Name of the modality."""
WITHOUT = (
    "this scene has no uncertainties; train it again, or run `real2sim fit-uncertainty SCENE LOG`"
)
"""Error message for scenes without uncertainty."""

# Clouds and skies are immutable and shared, and backends cache data derived from them.
_clouds: WeakKeyDictionary[GaussianCloud, GaussianCloud] = WeakKeyDictionary()
_skies: WeakKeyDictionary[Sky, Sky] = WeakKeyDictionary()


def uncertainty_request(request: RasterRequest) -> RasterRequest:
    """The pass whose image channels are the uncertainty, in [0, 1].

    Instances without uncertainties (inserted assets, shadows of edits) count as UNSEEN, and so does
    the background without a sky.

    Raises:
        RenderError: no instance has uncertainties.
    """
    if all(instance.cloud.uncertainties is None for instance in request.instances):
        raise RenderError(WITHOUT)
    options = replace(
        request.options,
        background=(UNSEEN, UNSEEN, UNSEEN),
        depth=False,
        instance=False,
        median_depth=False,
    )
    return replace(
        request,
        instances=tuple(map(shown_as_colour, request.instances)),
        sky=None if request.sky is None else _sky(request.sky),
        options=options,
    )


def shown_as_colour(instance: Instance) -> Instance:
    """The instance with uncertainties instead of colours."""
    found = _clouds.get(instance.cloud)
    if found is None:
        cloud = instance.cloud.with_uncertainties()
        assert cloud.uncertainties is not None
        sh = _grey((cloud.uncertainties - 0.5) / SH_C0)[:, None].contiguous()
        found = _clouds.setdefault(instance.cloud, replace(cloud, sh=sh, uncertainties=None))
    return replace(instance, cloud=found, colour=None)


def uncertainty_picture(uncertainty: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RGB visualisation [H, W, 3] of an image [H, W]: black (0) to pale yellow (UNSEEN)."""
    import cv2

    levels = np.rint(np.clip(uncertainty / UNSEEN, 0, 1) * 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1])


def _sky(sky: Sky) -> Sky:
    found = _skies.get(sky)
    if found is None:
        known = sky.uncertainties
        faces = torch.full_like(sky.faces, UNSEEN) if known is None else _grey(known).contiguous()
        found = _skies.setdefault(sky, Sky(faces))
    return found


def _grey(values: Tensor) -> Tensor:
    """[..., 3]."""
    return values[..., None].expand(*values.shape, 3)


ROUNDING_KERNELS = 2
"""Number of kernels that :func:`warm_up` prepares in addition to those of the backend."""


def at_once() -> None:
    """A ``ready`` function for images that are already complete."""


@dataclass(frozen=True, eq=False)
class Frame:
    """The images of one camera.

    Attributes:
        camera: name of the camera.
        images: by modality: ``rgb`` [H, W, 3] uint8, ``depth`` [H, W] float32 along the camera z
            axis [m], 0 where alpha is below 0.5, ``instance`` [H, W] uint16 ids, 0 is background,
            ``median_depth`` [H, W] float32 [m], 0 where alpha is below 0.5, ``semantic`` [H, W]
            uint8, see SEMANTIC_CLASSES, ``uncertainty`` [H, W] float32, expected absolute error
            of a colour in [0, 1].
        T_world_camera: [4, 4] float64, OpenCV camera frame to world.
        timing_ms: by stage; cameras drawn together share their time equally.
        ready: waits until the images are complete; only needed if rendering did not wait.
    """

    camera: str
    images: Mapping[str, NDArray[Any]]
    T_world_camera: NDArray[np.float64]
    timing_ms: dict[str, float] = field(default_factory=dict)
    ready: Callable[[], object] = at_once

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """The colour image. Raises KeyError if it was not requested."""
        return self.images["rgb"]

    @property
    def depth(self) -> NDArray[np.float32] | None:
        """The depth image; None if not requested."""
        return self.images.get("depth")

    @property
    def instance(self) -> NDArray[np.uint16] | None:
        """The instance image; None if not requested."""
        return self.images.get("instance")


@dataclass(frozen=True, eq=False)
class RigView:
    """The cameras of a vehicle and the scene that they see.

    Attributes:
        instances: instances of its world.
        cameras: cameras on the vehicle.
        T_world_vehicle: [4, 4] pose of the vehicle at mid-readout.
        sky: sky behind everything.
        twist: [6] velocity of the vehicle's origin [m/s] and angular velocity [rad/s], world frame,
            for cameras with a rolling shutter; None if stationary.
    """

    instances: Sequence[Instance]
    cameras: Sequence[Camera]
    T_world_vehicle: ArrayLike
    sky: Sky | None = None
    twist: NDArray[np.float64] | None = None


def render_cameras(
    instances: Sequence[Instance],
    cameras: Sequence[Camera],
    T_world_vehicle: ArrayLike,
    *,
    sky: Sky | None = None,
    options: RasterOptions = DEFAULT_OPTIONS,
    modalities: Sequence[str] | None = None,
    backend: str | Backend = "auto",
    between: Callable[[], object] | None = None,
    twist: NDArray[np.float64] | None = None,
) -> list[Frame]:
    """Render the frames of ``cameras``, in order.

    Cameras of one size are drawn in one call, and all cameras in one if the backend supports it.

    Args:
        instances: instances of the world, see rasterize().
        cameras: cameras on the vehicle.
        T_world_vehicle: [4, 4] pose of the vehicle.
        sky: sky behind everything.
        options: options of the pass.
        modalities: images of the frames; sets the switches of ``options``. None for rgb and the
            images selected by these switches.
        backend: renderer backend.
        between: callback between pieces of work, see RasterRequest.
        twist: twist of the vehicle, see RigView.

    Raises:
        RenderError: see rasterize(); also for a vehicle pose that is not rigid, and for an unknown
            modality.
    """
    view = RigView(instances, cameras, T_world_vehicle, sky, twist)
    return render_rigs(
        [view], options=options, modalities=modalities, backend=backend, between=between
    )[0]


def render_rigs(
    views: Sequence[RigView],
    *,
    options: RasterOptions = DEFAULT_OPTIONS,
    modalities: Sequence[str] | None = None,
    backend: str | Backend = "auto",
    between: Callable[[], object] | None = None,
    waits: bool = True,
) -> list[list[Frame]]:
    """Render frames of several vehicles, equal to :func:`render_cameras` of each.

    All are drawn in one call if the backend supports it, see :func:`draws_together`.

    Args:
        views: cameras and scene of each vehicle.
        options, modalities, backend, between: see :func:`render_cameras`.
        waits: whether to wait until images are complete; else call ``ready`` of each frame.

    Raises:
        RenderError: see :func:`render_cameras`; nothing is drawn if any vehicle fails.
    """
    if modalities is None:
        modalities = modalities_drawn(options)
    else:
        options = options_for(modalities, options)
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    groups = [(v, members) for v, view in enumerate(views) for members in alike(view.cameras)]
    requests = [_request(views[v], members, options, between) for v, members in groups]
    for request in requests:
        check_optics(chosen, request)
    frames: list[dict[int, Frame]] = [{} for _ in views]
    drawn = _drawn(requests, modalities, chosen)
    for (v, members), found in zip(groups, drawn, strict=True):
        made = _frames(views[v], members, found)
        if waits:
            found.ready()
        frames[v].update(zip(members, made, strict=True))
    return [[own[index] for index in range(len(own))] for own in frames]


def draws_together(backend: Backend, modalities: Iterable[str]) -> bool:
    """Whether ``backend`` draws images of these modalities in one call, for any content and size.

    Other backends may still batch small images of one size, see BatchBackend.
    """
    return isinstance(backend, FrameBackend) and backend.modalities.issuperset(modalities)


def warm_up(backend: str | Backend = "auto") -> None:
    """Compile or load everything that a first frame needs; takes half a minute the first time.

    For small images and clouds of few Gaussians see :func:`~.select.warm_up_small_images`.
    """
    made.expect(ROUNDING_KERNELS)
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    chosen.warm_up()
    camera = Camera("warm-up", 16, 16, np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.eye(4))
    render_cameras([], [camera], np.eye(4), backend=chosen)


def classes_of(instances: Sequence[Instance]) -> NDArray[np.uint8]:
    """Classes [65536] by instance id; the first instance with an id determines its class."""
    classes = np.full(MAX_INSTANCE_ID + 1, UNLABELED, np.uint8)
    for instance in reversed(instances):
        classes[instance.instance_id] = instance.semantic
    return classes


def alike(cameras: Sequence[Camera]) -> list[list[int]]:
    """Groups of camera indices: pinhole cameras by size, every other camera separately."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for index, camera in enumerate(cameras):
        own = () if camera.is_pinhole else (index,)
        groups.setdefault((camera.width, camera.height, *own), []).append(index)
    return list(groups.values())


def _request(
    view: RigView,
    members: Sequence[int],
    options: RasterOptions,
    between: Callable[[], object] | None,
) -> RasterRequest:
    """A request for cameras of one size. Raises RenderError."""
    vehicle = _vehicle_pose(view.T_world_vehicle)
    cameras = [view.cameras[index] for index in members]
    optics = None if cameras[0].is_pinhole else _optics(view, cameras[0], vehicle)
    viewmats = (
        [camera.viewmat(vehicle) for camera in cameras] if optics is None else [optics.viewmat]
    )
    return checked_request(
        view.instances,
        np.stack(viewmats),
        np.stack([camera.K for camera in cameras]),
        (cameras[0].width, cameras[0].height),
        sky=view.sky,
        options=options,
        between=between,
        optics=optics,
    )


def _optics(view: RigView, camera: Camera, vehicle: NDArray[np.float64]) -> LensView:
    """The lens of a camera, and its motion on the vehicle."""
    pose = camera.pose(vehicle)
    if view.twist is None or not camera.shutter.rolls:
        return LensView(camera, CameraMotion.still(pose))
    if view.twist.shape != (6,) or not np.isfinite(view.twist).all():
        raise RenderError(f"twist must be six finite numbers, not {view.twist.tolist()}")
    linear, angular = view.twist[:3], view.twist[3:]
    linear = linear + np.cross(angular, pose[:3, 3] - vehicle[:3, 3])
    seconds = camera.shutter.readout_us * 1e-6
    return LensView(camera, CameraMotion.about(pose, linear, angular, seconds))


def _vehicle_pose(given: ArrayLike) -> NDArray[np.float64]:
    pose = np.asarray(given, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise RenderError(f"T_world_vehicle must be [4, 4] and finite, not {pose.tolist()}")
    return pose


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Images [C, H, W, ...] by modality, milliseconds by stage, and the ``ready`` function."""

    images: Mapping[str, NDArray[Any]]
    timing_ms: Mapping[str, float]
    ready: Callable[[], object] = at_once


def _drawn(
    requests: Sequence[RasterRequest], modalities: Sequence[str], backend: Backend
) -> Iterator[_Drawn]:
    """The output of each request; uncertainty needs a separate pass."""
    if UNCERTAINTY not in modalities:
        yield from _drawn_in_colour(requests, modalities, backend)
        return
    others = [name for name in modalities if name != UNCERTAINTY]
    uncertain = [uncertainty_request(request) for request in requests]
    seen = _drawn_in_colour(requests, others, backend) if others else repeat(_Drawn({}, {}))
    for drawn, output in zip(seen, _rasterized(uncertain, backend), strict=False):
        own = replace(output, uncertainty=output.rgb[..., 0])
        images = {**drawn.images, UNCERTAINTY: modality_of(UNCERTAINTY).pixels(own)}
        timing = {**drawn.timing_ms, UNCERTAINTY: sum(output.timing_ms.values())}
        yield _Drawn(images, timing, drawn.ready)


def _drawn_in_colour(
    requests: Sequence[RasterRequest], modalities: Sequence[str], backend: Backend
) -> Iterator[_Drawn]:
    """The output of each request except uncertainty."""
    if requests and isinstance(backend, FrameBackend) and draws_together(backend, modalities):
        start = time.perf_counter()
        started = backend.start_frames(requests, modalities)
        cameras = sum(request.cameras for request in requests)
        each = (time.perf_counter() - start) * 1e3 / max(cameras, 1)
        for request, images in zip(requests, started.images, strict=True):
            yield _Drawn(images, {"total": each * request.cameras}, started.ready)
        return
    for request, output in zip(requests, _rasterized(requests, backend), strict=True):
        seen = output
        if "semantic" in modalities:
            classes, behind = classes_of(request.instances), class_behind(request)
            seen = replace(output, classes=classes, behind=behind)
        images = {name: modality_of(name).pixels(seen) for name in modalities}
        if request.optics is not None and "semantic" in images:
            # Pixels outside the lens show no sky.
            images["semantic"][0][tables_of(request.optics.camera).blind] = UNLABELED
        yield _Drawn(images, seen.timing_ms)


def _rasterized(requests: Sequence[RasterRequest], backend: Backend) -> Iterator[RenderOutput]:
    """Outputs of requests, in order; compatible small images are batched with equal results."""
    if not isinstance(backend, BatchBackend):
        yield from map(backend.rasterize, requests)
        return
    alike: dict[tuple[Any, ...], list[int]] = {}
    for k, request in enumerate(requests):
        if is_reduced(request):
            key = (request.width, request.height, id(request.sky), request.options)
            alike.setdefault(key, []).append(k)
    drawn: dict[int, RenderOutput] = {}
    for members in alike.values():
        if len(members) > 1:
            output = backend.rasterize_batch([requests[k] for k in members])
            drawn.update(_taken_apart(output, [requests[k].cameras for k in members], members))
    for k, request in enumerate(requests):
        yield drawn[k] if k in drawn else backend.rasterize(request)


def _taken_apart(
    output: RenderOutput, cameras: Sequence[int], numbers: Sequence[int]
) -> Iterator[tuple[int, RenderOutput]]:
    """Outputs of requests that were drawn in one call, with the index of each request."""
    first = 0
    for number, count in zip(numbers, cameras, strict=True):
        part = slice(first, first + count)
        timing_ms = {k: v * count / sum(cameras) for k, v in output.timing_ms.items()}
        first += count
        yield (
            number,
            replace(
                output,
                rgb=output.rgb[part],
                alpha=output.alpha[part],
                depth=None if output.depth is None else output.depth[part],
                instance=None if output.instance is None else output.instance[part],
                median_depth=None if output.median_depth is None else output.median_depth[part],
                timing_ms=timing_ms,
            ),
        )


def _frames(view: RigView, members: Sequence[int], drawn: _Drawn) -> list[Frame]:
    share = {stage: value / len(members) for stage, value in drawn.timing_ms.items()}
    vehicle = _vehicle_pose(view.T_world_vehicle)
    return [
        Frame(
            camera=view.cameras[index].name,
            images={name: pixels[c] for name, pixels in drawn.images.items()},
            T_world_camera=view.cameras[index].pose(vehicle),
            timing_ms=dict(share),
            ready=drawn.ready,
        )
        for c, index in enumerate(members)
    ]


# Lenses and rolling shutters: support and warm-up

EVERYTHING = RasterOptions(median_depth=True)


def refuse_lenses(backend: Backend, cameras: Sequence[Camera]) -> None:
    """Raise RenderError if ``backend`` cannot draw one of the cameras."""
    for camera in cameras:
        if not camera.is_pinhole and not draws_lens(backend):
            raise RenderError(no_lens(backend, camera))


def kernels_of_lenses_on_disk() -> bool:
    """Whether the disk cache has the slowest kernels of :func:`warm_up_lenses`."""
    from ._cpu.ray_project import project_rays  # Imported lazily, because it is rarely needed.

    return is_on_disk(project_rays)


def warm_up_lenses(backend: str | Backend = "auto") -> None:
    """Compile or load everything for frames with lenses or rolling shutters.

    Takes half a minute the first time.
    """
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    cloud = GaussianCloud(
        means=torch.tensor([[0.0, 0.0, 3.0], [0.2, 0.1, 0.4]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        scales=torch.full((2, 3), 0.3),
        opacities=torch.full((2,), 0.5),
        sh=torch.zeros(2, 1, 3),
    )
    K = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]])
    for shutter in (Shutter(), Shutter("top_to_bottom", 1000)):
        camera = Camera("warm-up", 16, 16, K, np.eye(4), BrownConrady(), shutter)
        sky = Sky.uniform((0.1, 0.2, 0.3))
        render_cameras(
            [Instance(cloud)], [camera], np.eye(4), sky=sky, options=EVERYTHING, backend=chosen
        )


# Labels: colour, depth and object of each pixel in one pass, also for objects without occluders

FRONT = 0.2
"""Transmittance that defines the front of a pixel for labels."""


@runtime_checkable
class LabelBackend(Protocol):
    """A Backend that computes labels in the colour pass."""

    def label(
        self,
        request: RasterRequest,
        windows: Sequence[Sequence[Window]],
        *,
        level: float,
        along_rays: bool = True,
    ) -> list[LabelOutput]:
        """Image and labels of each camera.

        Args:
            request: request without optics.
            windows: one window per object, by camera.
            level: transmittance that defines the front of a pixel: the Gaussian at which it first
                falls to this value or below. At most one half, which is used if ``level`` is not
                reached.
            along_rays: whether depth is at the maximum response along the pixel's ray; else it is
                the depth of the Gaussian's centre.
        """
        ...


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """Image and labels of one camera, see LabelOutput.

    Attributes:
        rgb: [H, W, 3] uint8, bitwise equal to an image without labels.
        depth: [H, W] float32 [m].
        instance: [H, W] uint16.
        alone: depths [h, w] float32 by window.
        T_world_camera: [4, 4].
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    alone: Sequence[NDArray[np.float32]]
    T_world_camera: NDArray[np.float64]


def labels_while_drawing(backend: Backend, cameras: Sequence[Camera]) -> bool:
    """Whether :func:`label_cameras` is supported; otherwise each label needs its own pass."""
    return isinstance(backend, LabelBackend) and all(camera.is_pinhole for camera in cameras)


def label_cameras(
    instances: Sequence[Instance],
    cameras: Sequence[Camera],
    T_world_vehicle: NDArray[np.float64],
    windows: Sequence[Sequence[Window]],
    *,
    sky: Sky | None,
    backend: LabelBackend,
) -> list[LabelledFrame]:
    """Render images and labels of ``cameras``, in order.

    Args:
        instances: instances of the world, see rasterize().
        cameras: pinhole cameras on the vehicle.
        T_world_vehicle: [4, 4] pose of the vehicle.
        windows: windows of objects to label without occluders, by camera.
        sky: sky behind everything.
        backend: renderer backend.

    Raises:
        RenderError: see rasterize().
    """
    frames: dict[int, LabelledFrame] = {}
    for members in alike(cameras):
        first = cameras[members[0]]
        request = checked_request(
            instances,
            np.stack([cameras[index].viewmat(T_world_vehicle) for index in members]),
            np.stack([cameras[index].K for index in members]),
            (first.width, first.height),
            sky=sky,
            options=DEFAULT_OPTIONS,
        )
        outputs = backend.label(request, [windows[index] for index in members], level=FRONT)
        for index, output in zip(members, outputs, strict=True):
            frames[index] = LabelledFrame(
                to_uint8(output.rgb),
                output.depth,
                output.instance,
                output.alone,
                cameras[index].pose(T_world_vehicle),
            )
    return [frames[index] for index in range(len(cameras))]
