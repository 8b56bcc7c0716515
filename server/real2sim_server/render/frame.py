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

# Uncertainty: a pass with uncertainties in place of colours. Gaussians, sky and blending are those
# of the colour image, so a pixel is the mean over its Gaussians, weighted by their share; merged
# Gaussians of small images have the mean of their members. Backends treat it as a colour.

UNCERTAINTY = "uncertainty"
"""Name of the modality."""
WITHOUT = (
    "it is not known of this scene how well its training rays determine what it shows; train it "
    "again, or run `real2sim fit-uncertainty SCENE LOG`"
)
"""Why a scene has no such images."""

# Clouds and skies are immutable and shared, and backends keep what they prepare of each.
_clouds: WeakKeyDictionary[GaussianCloud, GaussianCloud] = WeakKeyDictionary()
_skies: WeakKeyDictionary[Sky, Sky] = WeakKeyDictionary()


def uncertainty_request(request: RasterRequest) -> RasterRequest:
    """The pass whose image's channels are the uncertainty, in [0, 1].

    What has no uncertainties (an inserted asset, a shadow that an edit has made) counts as UNSEEN,
    and so does what is behind everything where there is no sky.

    Raises:
        RenderError: nothing of what is drawn has any.
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
    """The instance with uncertainties in place of its colours."""
    found = _clouds.get(instance.cloud)
    if found is None:
        cloud = instance.cloud.with_uncertainties()
        assert cloud.uncertainties is not None
        sh = _grey((cloud.uncertainties - 0.5) / SH_C0)[:, None].contiguous()
        found = _clouds.setdefault(instance.cloud, replace(cloud, sh=sh, uncertainties=None))
    return replace(instance, cloud=found, colour=None)


def uncertainty_picture(uncertainty: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RGB [H, W, 3] of an image [H, W] for people: from black (0) to pale yellow (UNSEEN)."""
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
    """For images that are whole: nothing has to be waited for."""


@dataclass(frozen=True, eq=False)
class Frame:
    """The images of one camera.

    Attributes:
        camera: its name.
        images: by modality: ``rgb`` [H, W, 3] uint8, ``depth`` [H, W] float32 along the camera z
            axis [m], 0 where alpha is below 0.5, ``instance`` [H, W] uint16 ids, 0 is background,
            ``median_depth`` [H, W] float32 [m], 0 where alpha is below 0.5, ``semantic`` [H, W]
            uint8, see SEMANTIC_CLASSES, ``uncertainty`` [H, W] float32, expected absolute error
            of a colour, of 1.
        T_world_camera: [4, 4] float64, OpenCV camera frame to world.
        timing_ms: by stage; cameras drawn together share their time equally.
        ready: returns when the images are whole; nobody has to ask but who asked not to wait.
    """

    camera: str
    images: Mapping[str, NDArray[Any]]
    T_world_camera: NDArray[np.float64]
    timing_ms: dict[str, float] = field(default_factory=dict)
    ready: Callable[[], object] = at_once

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """The colour image. Raises KeyError where it was not requested."""
        return self.images["rgb"]

    @property
    def depth(self) -> NDArray[np.float32] | None:
        """The depth image; None when not requested."""
        return self.images.get("depth")

    @property
    def instance(self) -> NDArray[np.uint16] | None:
        """The instance image; None when not requested."""
        return self.images.get("instance")


@dataclass(frozen=True, eq=False)
class RigView:
    """The cameras of a vehicle and the scene before them.

    Attributes:
        instances: what is in its world.
        cameras: on the vehicle.
        T_world_vehicle: [4, 4] pose of the vehicle, in the middle of a read-out.
        sky: behind everything.
        twist: [6] of the vehicle, velocity [m/s] of its origin and angular velocity [rad/s] in the
            world, for cameras with a rolling shutter; None: it stands.
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
    """Frames of ``cameras`` in their order; cameras of one size are drawn in one call,
    and all in one where the backend can.

    Args:
        instances: what is in the world, see rasterize().
        cameras: on the vehicle.
        T_world_vehicle: [4, 4] pose of the vehicle.
        sky: behind everything.
        options: of the pass.
        modalities: images that the frames have, and with them the switches of ``options``; None
            for rgb and what those switches say.
        backend: draws.
        between: called between pieces of the work, see RasterRequest.
        twist: of the vehicle, see RigView.

    Raises:
        RenderError: as rasterize(); also for a vehicle pose that is not rigid, and for a modality
            that nobody has registered.
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
    """Frames of several vehicles, as :func:`render_cameras` gives each; all are drawn in one call
    where the backend can, see :func:`draws_together`.

    Args:
        views: what the cameras of each vehicle look at.
        options, modalities, backend, between: as of :func:`render_cameras`.
        waits: until images are whole; else each is once its frame's ``ready`` has returned.

    Raises:
        RenderError: as :func:`render_cameras`, for any of them; nothing is drawn then.
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
    """Whether images of these modalities are drawn in one go, whatever is in them and of any size;
    small ones of one size may be by other backends too, see BatchBackend."""
    return isinstance(backend, FrameBackend) and backend.modalities.issuperset(modalities)


def warm_up(backend: str | Backend = "auto") -> None:
    """Compile or load everything a first frame would wait for, which takes half a minute the first
    time; for small images and clouds of few Gaussians there is
    :func:`~.select.warm_up_small_images`."""
    made.expect(ROUNDING_KERNELS)
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    chosen.warm_up()
    camera = Camera("warm-up", 16, 16, np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.eye(4))
    render_cameras([], [camera], np.eye(4), backend=chosen)


def classes_of(instances: Sequence[Instance]) -> NDArray[np.uint8]:
    """Classes [65536] by instance id, of the first that has it."""
    classes = np.full(MAX_INSTANCE_ID + 1, UNLABELED, np.uint8)
    for instance in reversed(instances):
        classes[instance.instance_id] = instance.semantic
    return classes


def alike(cameras: Sequence[Camera]) -> list[list[int]]:
    """Indices of pinholes of one size each, and of every other camera by itself."""
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
    """Images [C, H, W, ...] by modality, milliseconds by stage, and what waits for the images."""

    images: Mapping[str, NDArray[Any]]
    timing_ms: Mapping[str, float]
    ready: Callable[[], object] = at_once


def _drawn(
    requests: Sequence[RasterRequest], modalities: Sequence[str], backend: Backend
) -> Iterator[_Drawn]:
    """The output of each request; uncertainty takes a pass of its own."""
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
    """By the passes that draw colours."""
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
            # Where the lens sees nothing there is no sky, either.
            images["semantic"][0][tables_of(request.optics.camera).blind] = UNLABELED
        yield _Drawn(images, seen.timing_ms)


def _rasterized(requests: Sequence[RasterRequest], backend: Backend) -> Iterator[RenderOutput]:
    """Outputs of requests in their order; small images alike are drawn in one go where the backend
    can, the same bits as one by one."""
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
    """Outputs of requests that were drawn in one go, by their numbers."""
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
    """Raises RenderError where ``backend`` cannot draw one of the cameras."""
    for camera in cameras:
        if not camera.is_pinhole and not draws_lens(backend):
            raise RenderError(no_lens(backend, camera))


def kernels_of_lenses_on_disk() -> bool:
    """Whether an earlier run left what :func:`warm_up_lenses` compiles longest."""
    from ._cpu.ray_project import project_rays  # Imported only where it is needed.

    return is_on_disk(project_rays)


def warm_up_lenses(backend: str | Backend = "auto") -> None:
    """Compile or load everything that a first frame through a lens or a rolling shutter would wait
    for; takes half a minute the first time."""
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


# Labels: colours, depth and object of each pixel in one walk, also of objects as if alone

FRONT = 0.2
"""Transmittance at which the front of a pixel lies, of what labels show."""


@runtime_checkable
class LabelBackend(Protocol):
    """A Backend that finds labels while it draws colours."""

    def label(
        self,
        request: RasterRequest,
        windows: Sequence[Sequence[Window]],
        *,
        level: float,
        along_rays: bool = True,
    ) -> list[LabelOutput]:
        """Picture and labels of each camera.

        Args:
            request: without optics.
            windows: of objects, one each, by camera.
            level: transmittance at which the front of a pixel lies, the Gaussian that brings it
                there or below; at most a half, which counts where it is not reached.
            along_rays: whether depth is where a pixel's ray meets its front most, or the depth of
                the front's centre.
        """
        ...


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """One camera's picture and labels, see LabelOutput.

    Attributes:
        rgb: [H, W, 3] uint8, the bytes of a picture alone.
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
    """Whether :func:`label_cameras` can do it: others draw a pass for each label."""
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
    """Pictures and labels of ``cameras`` in their order.

    Args:
        instances: what is in the world, see rasterize().
        cameras: pinholes on the vehicle.
        T_world_vehicle: [4, 4] pose of the vehicle.
        windows: of objects that are also asked for alone, by camera.
        sky: behind everything.
        backend: draws.

    Raises:
        RenderError: as rasterize().
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
