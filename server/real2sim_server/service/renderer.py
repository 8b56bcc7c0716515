"""Renders instances to frames on the engine, and encodes frames on other threads."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, TypeVar, get_args

import numpy as np
import structlog
from fastapi import Response
from numpy.typing import NDArray

from real2sim_proto import ErrorCode
from real2sim_proto import encode as encode_message
from real2sim_proto.base import Codec, Modality
from real2sim_proto.episode import SensorSpec
from real2sim_proto.sensors import MotionBlurSpec

from ..render import (
    Backend,
    Frame,
    Instance,
    RasterOptions,
    RigView,
    draws_together,
    kernels_of_small_images_on_disk,
    render_rigs,
    uses_levels,
    warm_up,
    warm_up_small_images,
)
from ..render.backend import device_of
from ..render.frame import UNCERTAINTY, WITHOUT, at_once
from ..render.images import JpegEncoder, jpeg_encoder_for, turbo_jpeg, with_effects
from ..render.lens import with_ground
from ..render.modalities import modality_names, modality_of, options_for
from ..scene import Camera, CameraRig, Scene, SceneError
from .engine import Engine, Priority, lower_priority
from .frames import EncodedFrame, FollowingImage, RenderedImage, blurred, camera_with, encode_frame
from .http.responses import ServiceError, choose_among, etag
from .http.telemetry import Metrics
from .library.scenes import MemoryBudget
from .render_background import BackgroundCompile, DetailLevels, LensKernels

log = structlog.get_logger(__name__)

T = TypeVar("T")
R = TypeVar("R")

MAX_ENCODERS = 8
BULK_NICENESS = 10
"""Niceness of the thread that encodes large images; the engine has a higher priority."""

VIEW_PIXELS = 2_000_000
"""Requests with more pixels have a lower priority than interactive ones."""
DEFAULT_OPTIONS = RasterOptions()


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """Inputs for rendering the sensors at one time.

    Attributes:
        scene: provides the sky; its clouds are those of ``instances``.
        instances: the instances to render.
        T_world_vehicle: [4, 4] float64, pose of the rig.
        t_us: time, written to the frames [us].
        sensors: cameras, modalities, sizes and codecs.
        rig: rig of the cameras; default: the scene's.
        twist: [6] twist of the vehicle, see RigView; for rolling shutters and motion blur.
    """

    scene: Scene
    instances: Sequence[Instance]
    T_world_vehicle: NDArray[np.float64]
    t_us: int
    sensors: Sequence[SensorSpec]
    rig: CameraRig | None = None
    twist: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class RenderedFrames:
    """Frames in the order of sensors and modalities, and milliseconds by stage."""

    frames: list[EncodedFrame]
    timing_ms: dict[str, float] = field(default_factory=dict)


class Renderer:
    """Executes render requests.

    Rendering runs on the engine. Encoding runs in parallel on half of the cores. simplejpeg,
    nvImageCodec and OpenCV release the GIL, so the engine can render the next request and the event
    loop stays free. A 1920x1280 jpeg takes 17 ms on the CPU, a png 170 ms; in both cases the loop's
    median lag is below 0.2 ms.

    Args:
        engine: runs the rendering.
        backend: the rasterizer.
        metrics: receives durations by stage.
        max_pixels: limit over all sensors and modalities of one request.
        budget: memory budget, which includes levels of detail.

    Attributes:
        levels: levels of detail; small images wait for them before they are queued.
        small_images: the kernels for small images.
        jpeg: the jpeg encoder, chosen by :meth:`warm_up`.
    """

    def __init__(
        self,
        engine: Engine,
        backend: Backend,
        metrics: Metrics,
        *,
        max_pixels: int,
        budget: MemoryBudget | None = None,
    ) -> None:
        self.levels = DetailLevels(backend, budget)
        self.jpeg: JpegEncoder = turbo_jpeg
        self._engine = engine
        self._backend = backend
        # An isinstance check against a protocol would take 20 us per step.
        self._draws_together = cache(partial(draws_together, backend))
        self._uses_levels = cache(partial(uses_levels, backend))
        self._metrics = metrics
        self._max_pixels = max_pixels
        self._lenses = LensKernels(engine, backend)
        self.small_images = BackgroundCompile(
            engine,
            "small images",
            warm_up_small_images,
            on_disk=kernels_of_small_images_on_disk,
            backend=backend,
        )
        self._encoders = ThreadPoolExecutor(encoder_threads(), thread_name_prefix="encode")
        self._bulk_encoders = ThreadPoolExecutor(
            1,
            thread_name_prefix="encode-bulk",
            initializer=lower_priority,
            initargs=(BULK_NICENESS,),
        )

    def close(self) -> None:
        """End the renderer's threads."""
        self.levels.close()
        self.small_images.close()
        self._encoders.shutdown(cancel_futures=True)
        self._bulk_encoders.shutdown(cancel_futures=True)

    async def warm_up(self) -> None:
        """Render and encode once in every form, to avoid slow first frames."""
        await self._engine.call(warm_up, self._backend, label="warm-up")
        self.jpeg, why = await asyncio.to_thread(jpeg_encoder_for, device_of(self._backend))
        log.info("jpeg", encoder=why)
        await self.encode(list(_samples()))

    async def render(self, request: RenderRequest, *, stream: str = "rest") -> RenderedFrames:
        """Render and encode all sensors of a request.

        Raises:
            ServiceError: UNKNOWN_CAMERA, INVALID_REQUEST for too many pixels or images that the
                scene lacks, or OUT_OF_MEMORY for levels of detail.
            QueueFullError, RenderError: from the engine and the rasterizer.
        """
        rig = request.rig or request.scene.rig
        cameras = check_sensors(rig, request.sensors, max_pixels=self._max_pixels)
        check_known(request.scene, request.sensors)
        await self.ready(request.sensors, cameras, lambda: request.instances)
        submitted = time.perf_counter()
        priority = _priority(cameras, stream)
        images, render_ms = await self._engine.call(
            partial(self.render_images, request, cameras, between=self._engine.yield_to_urgent),
            label="render",
            priority=priority,
        )
        queue_ms = (time.perf_counter() - submitted) * 1e3 - render_ms
        started = time.perf_counter()
        frames = await self.encode(images, priority=priority)
        encode_ms = (time.perf_counter() - started) * 1e3
        timing = {"queue": queue_ms, "render": render_ms, "encode": encode_ms}
        self._count(frames, timing, stream)
        return RenderedFrames(frames, timing)

    async def ready(
        self,
        sensors: Sequence[SensorSpec],
        cameras: Sequence[Camera],
        things: Callable[[], Sequence[Instance]],
    ) -> None:
        """Wait for the levels of detail and the kernels of lenses and small images.

        Rendering then does not delay other requests.

        Raises:
            ServiceError: OUT_OF_MEMORY, or INVALID_REQUEST if the backend does not support lenses.
        """
        if not all(camera.is_pinhole for camera in cameras):
            await self._lenses.ready(cameras)
        if any(
            self._uses_levels(camera.width, camera.height, sensor.detail)
            for sensor, camera in zip(sensors, cameras, strict=True)
        ):
            await self.small_images.ready()
            await self.levels.ready(sensors, cameras, things)

    async def encode(
        self, images: Iterable[RenderedImage], *, priority: Priority = Priority.DRIVE
    ) -> list[EncodedFrame]:
        """Encode images; returns their frames in order.

        Complete raw images are used as they are; all others are encoded on the encoder threads.
        """
        images = list(images)
        if all(image.ready is at_once and image.sensor.codec == "raw" for image in images):
            return [encode_frame(image) for image in images]
        return await self.on_encoders(
            partial(encode_frame, jpeg=self.jpeg), images, priority=priority
        )

    async def on_encoders(
        self, fn: Callable[[T], R], items: Iterable[T], *, priority: Priority = Priority.DRIVE
    ) -> list[R]:
        """Map ``fn`` over items on the encoder threads; returns the results in order."""
        loop = asyncio.get_running_loop()
        encoders = self._bulk_encoders if priority is Priority.BULK else self._encoders
        work = [loop.run_in_executor(encoders, fn, item) for item in items]
        try:
            return await asyncio.gather(*work)
        except Exception as error:
            # These images were still being copied from the device.
            self._engine.note_error(error)
            raise

    def render_images(
        self,
        request: RenderRequest,
        cameras: Sequence[Camera],
        *,
        between: Callable[[], object] | None = None,
    ) -> tuple[list[RenderedImage], float]:
        """Render all sensors on the engine thread; returns the images and the duration [ms].

        ``between`` is called between pieces of the work.
        """
        started = time.perf_counter()
        images = self.render_together([(request, cameras)], between=between)[0]
        return images, (time.perf_counter() - started) * 1e3

    def draws_together(self, sensors: Sequence[SensorSpec], cameras: Sequence[Camera]) -> bool:
        """Whether images of these sensors can be rendered in one batch with similar ones.

        Args:
            sensors: the sensors.
            cameras: their cameras in the same order, at the requested sizes.
        """
        modalities = frozenset(name for sensor in sensors for name in sensor.modalities)
        return self._draws_together(modalities) or all(
            self._uses_levels(camera.width, camera.height, sensor.detail)
            for sensor, camera in zip(sensors, cameras, strict=True)
        )

    def render_together(
        self,
        requests: Sequence[tuple[RenderRequest, Sequence[Camera]]],
        *,
        between: Callable[[], object] | None = None,
    ) -> list[list[RenderedImage]]:
        """Images of all sensors of each request, batched if one pass can render them.

        Runs on the engine thread, which continues while images are copied from the device.

        Args:
            requests: each with the cameras of its sensors, in order.
            between: called between parts of the work.

        Raises:
            RenderError: from any request.
        """
        passes = _passes([request for request, _ in requests])
        images: list[dict[int, list[RenderedImage]]] = [{} for _ in requests]
        for (options, modalities), members in passes.items():
            views = [_rig_view(*requests[r], indices) for r, indices in members.items()]
            drawn = render_rigs(
                views,
                options=options,
                modalities=modalities,
                backend=self._backend,
                between=between,
                waits=False,
            )
            for (r, indices), frames in zip(members.items(), drawn, strict=True):
                request, cameras = requests[r]
                for i, frame in zip(indices, frames, strict=True):
                    images[r][i] = [
                        self._image(request, request.sensors[i], cameras[i], frame, name)
                        for name in request.sensors[i].modalities
                    ]
        return [
            [image for i in range(len(request.sensors)) for image in found[i]]
            for (request, _), found in zip(requests, images, strict=True)
        ]

    def _image(
        self, request: RenderRequest, sensor: SensorSpec, camera: Camera, frame: Frame, name: str
    ) -> RenderedImage:
        """One image of a sensor, with the sensor's effects."""
        image = RenderedImage(
            sensor,
            name,
            request.t_us,
            frame.T_world_camera,
            camera.K,
            frame.images[name],
            frame.ready,
            camera,
        )
        if name == "semantic":
            return _with_ground(image, request.scene, frame, camera)
        effects = sensor.effects
        if effects is None or name != "rgb" or not effects.names:
            return image
        drawn, ready = frame.rgb, frame.ready
        if effects.motion_blur is not None:
            drawn, ready = self._blurred(request, camera, effects.motion_blur), at_once
        of = sensor.camera, request.t_us
        made = FollowingImage(drawn, ready, partial(with_effects, drawn, effects, *of))
        return replace(image, pixels=made.pixels, ready=made.ready)

    def _blurred(
        self, request: RenderRequest, camera: Camera, blur: MotionBlurSpec
    ) -> NDArray[np.uint8]:
        def draw(view: RigView) -> NDArray[np.uint8]:
            [[frame]] = render_rigs([view], modalities=("rgb",), backend=self._backend)
            return frame.rgb

        return blurred(_rig_view(request, [camera], [0]), blur, draw)

    def _count(
        self, frames: Sequence[EncodedFrame], timing_ms: dict[str, float], stream: str
    ) -> None:
        for stage, ms in timing_ms.items():
            self._metrics.stages.labels(stage).observe(ms / 1e3)
        for frame in frames:
            self._metrics.frames.labels(stream, frame.codec).inc()


def encoder_threads() -> int:
    """Number of images that are encoded in parallel: half of the cores, at least two."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return max(2, min(MAX_ENCODERS, cores // 2))


def _priority(cameras: Sequence[Camera], stream: str) -> Priority:
    """Priority of a request: frames of a film have a lower one."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    return Priority.BULK if stream == "export" or pixels > VIEW_PIXELS else Priority.VIEW


Pass = tuple[RasterOptions, tuple[str, ...]]
"""A batched pass: its options and modalities."""


def _passes(requests: Sequence[RenderRequest]) -> dict[Pass, dict[int, list[int]]]:
    """Indices of the sensors of each request, by rendering pass."""
    passes: dict[Pass, dict[int, list[int]]] = {}
    for r, request in enumerate(requests):
        for options, indices in _sensors_by_options(request.sensors).items():
            modalities = _modalities(request.sensors[i] for i in indices)
            passes.setdefault((options, modalities), {})[r] = indices
    return passes


def _sensors_by_options(sensors: Sequence[SensorSpec]) -> dict[RasterOptions, list[int]]:
    found: dict[RasterOptions, list[int]] = {}
    for i, sensor in enumerate(sensors):
        options = replace(DEFAULT_OPTIONS, detail=sensor.detail)
        found.setdefault(options_for(_modalities([sensor]), options), []).append(i)
    return found


def _with_ground(image: RenderedImage, scene: Scene, frame: Frame, camera: Camera) -> RenderedImage:
    """A semantic image in which the ground has its own class."""

    def found() -> NDArray[np.uint8]:
        depth = frame.images["median_depth"]
        return with_ground(image.pixels, depth, camera, frame.T_world_camera, scene.ground)

    made = FollowingImage(image.pixels, image.ready, found)
    return replace(image, pixels=made.pixels, ready=made.ready)


def _modalities(sensors: Iterable[SensorSpec]) -> tuple[str, ...]:
    """All modalities that the sensors require, without duplicates, and their inputs."""
    wanted = {name for sensor in sensors for name in sensor.modalities}
    if "semantic" in wanted:
        wanted.add("median_depth")
    return tuple(name for name in modality_names() if name in wanted)


def _rig_view(request: RenderRequest, cameras: Sequence[Camera], indices: Sequence[int]) -> RigView:
    return RigView(
        instances=request.instances,
        cameras=[cameras[i] for i in indices],
        T_world_vehicle=request.T_world_vehicle,
        sky=request.scene.sky,
        twist=request.twist,
    )


def _samples() -> Iterator[RenderedImage]:
    for codec in get_args(Codec):
        for name in modality_names():
            modality = modality_of(name)
            sensor = SensorSpec(camera="warm-up", codec=codec)
            pixels = np.zeros(modality.shape(16, 16), modality.dtype)
            yield RenderedImage(sensor, name, 0, np.eye(4), np.eye(3), pixels)


def check_known(scene: Scene, sensors: Iterable[SensorSpec]) -> None:
    """Refuse images that the scene cannot provide.

    Raises:
        ServiceError: INVALID_REQUEST for uncertainty, if the scene has none.
    """
    asked = any(UNCERTAINTY in sensor.modalities for sensor in sensors)
    if asked and not scene.has_uncertainties:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"scene {scene.name!r} has no images {UNCERTAINTY!r}: {WITHOUT}",
            hint="request other modalities, or use a scene whose has_uncertainties is true",
        )


def check_sensors(
    rig: CameraRig, sensors: Sequence[SensorSpec], *, max_pixels: int
) -> list[Camera]:
    """The cameras of ``sensors`` at the requested sizes.

    Raises:
        ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels or invalid optics.
    """
    cameras = []
    for sensor in sensors:
        try:
            camera = rig[sensor.camera]
        except SceneError as error:
            raise ServiceError(ErrorCode.UNKNOWN_CAMERA, str(error)) from error
        try:
            camera = camera_with(camera, sensor.optics)
            cameras.append(camera.resized(sensor.width or camera.width))
        except SceneError as error:
            raise ServiceError(ErrorCode.INVALID_REQUEST, str(error)) from error
    pixels = sum(
        c.width * c.height * len(s.modalities) for c, s in zip(cameras, sensors, strict=True)
    )
    if pixels > max_pixels:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"{pixels} pixels in one go; this worker allows {max_pixels}",
            hint="ask for smaller or fewer images",
        )
    return cameras


# --- HTTP replies --------------------------------------------------------------------------------

CODEC_OF: dict[str, Codec] = {
    "image/jpeg": "jpeg",
    "image/png": "png",
    "application/msgpack": "raw",
}
"""Codec by media type, in order of preference."""

FRAME_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "one frame, in the form that Accept picks",
        "content": {
            "image/jpeg": {"schema": {"type": "string", "format": "binary"}},
            "image/png": {"schema": {"type": "string", "format": "binary"}},
            "application/msgpack": {"schema": {"type": "string", "format": "binary"}},
        },
    }
}


def choose_media_type(accept: str | None, modality: Modality) -> str:
    """The media type that the client prefers (RFC 9110, section 12.5.1).

    Raises:
        ServiceError: NOT_ACCEPTABLE if the client accepts none of them; depth and instance are
            never jpeg.
    """
    codecs = modality_of(modality).codecs
    offered = [media_type for media_type, codec in CODEC_OF.items() if codec in codecs]
    return choose_among(offered, accept, of=f"modality {modality!r}")


MSGPACK = "application/msgpack"


def choose_frames_type(accept: str | None, modalities: Sequence[Modality]) -> str:
    """The media type for images of these modalities: msgpack, or an image format for one image."""
    if len(modalities) == 1:
        return choose_media_type(accept, modalities[0])
    return choose_among([MSGPACK], accept, of="more than one image")


def frames_response(rendered: RenderedFrames, media_type: str, *, t_us: int) -> Response:
    """The response with all frames of one time; a single frame can also be an image file."""
    if media_type != MSGPACK:
        return frame_response(rendered, media_type)
    view = {"t_us": t_us, "frames": [frame.fields for frame in rendered.frames]}
    view["timing"] = rendered.timing_ms
    headers = {"Vary": "Accept", "Cache-Control": "no-store"}
    return Response(encode_message(view), media_type=MSGPACK, headers=headers)


def frame_response(
    rendered: RenderedFrames, media_type: str, *, revision: int | None = None
) -> Response:
    """The response with the first frame.

    msgpack contains the whole frame (pose, intrinsics, raw pixels) as on the drive socket. Image
    files also have the milliseconds by stage in ``Server-Timing``.
    """
    frame = rendered.frames[0]
    content: bytes = bytes(frame.data)
    if media_type == MSGPACK:
        content = encode_message(frame.fields)
    timing = ", ".join(f"{stage};dur={ms:.2f}" for stage, ms in rendered.timing_ms.items())
    headers = {"Server-Timing": timing, "Vary": "Accept", "Cache-Control": "no-store"}
    if revision is not None:
        headers["X-Real2Sim-Revision"] = etag(revision)
    return Response(content, media_type=media_type, headers=headers)
