"""What the cameras of a vehicle see at one instant."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..scene import Camera
from .backends.base import Backend, FrameBackend, RasterRequest
from .backends.select import select_backend
from .modalities import modalities_drawn, modality_of, options_for
from .rasterize import DEFAULT_OPTIONS, checked_request
from .types import Instance, RasterOptions, RenderError, Sky


@dataclass(frozen=True, eq=False)
class Frame:
    """The images of one camera.

    Attributes:
        camera: its name.
        images: by modality: ``rgb`` [H, W, 3] uint8, ``depth`` [H, W] float32 along the camera z
            axis [m], 0 where alpha is below 0.5, ``instance`` [H, W] uint16 ids, 0 is background.
        T_world_camera: [4, 4] float64, OpenCV camera frame to world.
        timing_ms: by stage; cameras drawn together share their time equally.
    """

    camera: str
    images: Mapping[str, NDArray[Any]]
    T_world_camera: NDArray[np.float64]
    timing_ms: dict[str, float] = field(default_factory=dict)

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """The colour image. Raises KeyError where it was not asked for."""
        return self.images["rgb"]

    @property
    def depth(self) -> NDArray[np.float32] | None:
        """The depth image; None when not asked for."""
        return self.images.get("depth")

    @property
    def instance(self) -> NDArray[np.uint16] | None:
        """The instance image; None when not asked for."""
        return self.images.get("instance")


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

    Raises:
        RenderError: as rasterize(); also for a vehicle pose that is not rigid, and for a modality
            that nobody has registered.
    """
    vehicle = np.asarray(T_world_vehicle, dtype=np.float64)
    if vehicle.shape != (4, 4) or not np.isfinite(vehicle).all():
        raise RenderError(f"T_world_vehicle must be [4, 4] and finite, not {vehicle.tolist()}")
    if modalities is None:
        modalities = modalities_drawn(options)
    else:
        options = options_for(modalities, options)
    groups: dict[tuple[int, int], list[int]] = {}
    for index, camera in enumerate(cameras):
        groups.setdefault((camera.width, camera.height), []).append(index)
    drawn = tuple(instances)
    requests = [
        checked_request(
            drawn,
            np.stack([cameras[index].viewmat(vehicle) for index in members]),
            np.stack([cameras[index].K for index in members]),
            size,
            sky=sky,
            options=options,
            between=between,
        )
        for size, members in groups.items()
    ]
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    frames: dict[int, Frame] = {}
    for members, (images, timing_ms) in zip(
        groups.values(), _drawn(requests, modalities, chosen), strict=True
    ):
        group = [cameras[index] for index in members]
        frames.update(zip(members, _frames(group, vehicle, images, timing_ms), strict=True))
    return [frames[index] for index in range(len(cameras))]


def warm_up(backend: str | Backend = "auto") -> None:
    """Compile or load everything a first frame would wait for; takes seconds the first time."""
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    chosen.warm_up()
    camera = Camera("warm-up", 16, 16, np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.eye(4))
    render_cameras([], [camera], np.eye(4), backend=chosen)


def _drawn(
    requests: Sequence[RasterRequest], modalities: Sequence[str], backend: Backend
) -> Iterator[tuple[Mapping[str, NDArray[Any]], dict[str, float]]]:
    """Images [C, H, W, ...] by modality of each request, and milliseconds by stage."""
    if isinstance(backend, FrameBackend) and backend.modalities.issuperset(modalities):
        start = time.perf_counter()
        finished = backend.frames(requests, modalities) if requests else []
        cameras = sum(request.cameras for request in requests)
        each = (time.perf_counter() - start) * 1e3 / max(cameras, 1)
        for request, images in zip(requests, finished, strict=True):
            yield images, {"total": each * request.cameras}
        return
    for request in requests:
        output = backend.rasterize(request)
        yield {name: modality_of(name).pixels(output) for name in modalities}, output.timing_ms


def _frames(
    cameras: Sequence[Camera],
    vehicle: NDArray[np.float64],
    images: Mapping[str, NDArray[Any]],
    timing_ms: Mapping[str, float],
) -> list[Frame]:
    share = {stage: value / len(cameras) for stage, value in timing_ms.items()}
    return [
        Frame(
            camera=camera.name,
            images={name: pixels[c] for name, pixels in images.items()},
            T_world_camera=camera.pose(vehicle),
            timing_ms=dict(share),
        )
        for c, camera in enumerate(cameras)
    ]
