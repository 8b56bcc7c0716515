"""From instances to encoded frames: drawn on the engine, encoded beside it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from real2sim_proto import ErrorCode
from real2sim_proto.base import Codec, Modality
from real2sim_proto.drive import Frame, SensorSpec

from ...render import Backend, Instance, RasterOptions, encode_image, render_cameras, warm_up
from ...scene import Camera, CameraRig, Scene, SceneError
from ..http.metrics import Metrics
from ..http.problems import ServiceError
from .engine import Engine

T = TypeVar("T")
R = TypeVar("R")

A = TypeVar("A")
B = TypeVar("B")

ENCODER_THREADS = 2


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """All that is needed to draw the sensors of one instant.

    Attributes:
        scene: gives the sky; its clouds are those of ``instances``.
        instances: what is drawn.
        T_world_vehicle: [4, 4] float64, where the rig stands.
        t_us: instant, noted in the frames [us].
        sensors: cameras, modalities, sizes and codecs.
    """

    scene: Scene
    instances: Sequence[Instance]
    T_world_vehicle: NDArray[np.float64]
    t_us: int
    sensors: Sequence[SensorSpec]


@dataclass(frozen=True, eq=False)
class Image:
    """One drawn image on its way into a frame."""

    sensor: SensorSpec
    modality: Modality
    t_us: int
    T_world_sensor: NDArray[np.float64]
    K: NDArray[np.float64]
    pixels: NDArray[Any]


@dataclass(frozen=True, eq=False)
class RenderedFrames:
    """Frames in the order of sensors and modalities, and milliseconds by stage."""

    frames: list[Frame]
    timing_ms: dict[str, float] = field(default_factory=dict)


class Renderer:
    """Draws shots.

    Drawing runs on the engine. Encoding runs on a small pool of its own: simplejpeg and OpenCV
    release the GIL, so the engine draws the next shot meanwhile and the event loop stays free. A
    1920x1280 jpeg takes 17 ms, a png 170 ms; either way the loop's median lag is below 0.2 ms.

    Args:
        engine: runs the drawing.
        backend: draws.
        metrics: gets durations by stage.
        max_pixels: over all sensors and modalities of one shot.
    """

    def __init__(
        self, engine: Engine, backend: Backend, metrics: Metrics, *, max_pixels: int
    ) -> None:
        self._engine = engine
        self._backend = backend
        self._metrics = metrics
        self._max_pixels = max_pixels
        self._encoders = ThreadPoolExecutor(ENCODER_THREADS, thread_name_prefix="encode")

    def close(self) -> None:
        """End the encoder threads."""
        self._encoders.shutdown(cancel_futures=True)

    async def warm_up(self) -> None:
        """Draw and encode something in every form, so that no first frame waits for it."""
        await self._engine.call(warm_up, self._backend, label="warm-up")
        await self.on_encoders(encode, list(_samples()))

    async def take(self, shot: RenderRequest, *, stream: str = "rest") -> RenderedFrames:
        """Draw and encode all sensors of a shot.

        Raises:
            ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels.
            QueueFullError, RenderError: as the engine and the renderer do.
        """
        cameras = check_sensors(shot.scene.rig, shot.sensors, max_pixels=self._max_pixels)
        asked = time.perf_counter()
        images, drawn_ms = await self._engine.call(self.draw, shot, cameras, label="render")
        waited_ms = (time.perf_counter() - asked) * 1e3 - drawn_ms
        started = time.perf_counter()
        frames = await self.on_encoders(encode, images)
        timing = {
            "queue": waited_ms,
            "render": drawn_ms,
            "encode": (time.perf_counter() - started) * 1e3,
        }
        self._note(frames, timing, stream)
        return RenderedFrames(frames, timing)

    async def on_encoders(self, fn: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """``fn`` of each item, in order, on the encoder threads."""
        loop = asyncio.get_running_loop()
        work = [loop.run_in_executor(self._encoders, fn, item) for item in items]
        return await asyncio.gather(*work)

    def draw(self, shot: RenderRequest, cameras: Sequence[Camera]) -> tuple[list[Image], float]:
        """Images of all sensors, and the milliseconds it took; on the engine thread."""
        started = time.perf_counter()
        drawn: dict[int, list[Image]] = {}
        for options, members in _by_options(shot.sensors).items():
            frames = render_cameras(
                shot.instances,
                [cameras[i] for i in members],
                shot.T_world_vehicle,
                sky=shot.scene.sky,
                options=options,
                backend=self._backend,
            )
            for i, frame in zip(members, frames, strict=True):
                drawn[i] = [
                    Image(shot.sensors[i], m, shot.t_us, frame.T_world_camera, cameras[i].K, pixels)
                    for m in shot.sensors[i].modalities
                    if (pixels := getattr(frame, m)) is not None
                ]
        images = [image for i in range(len(shot.sensors)) for image in drawn[i]]
        return images, (time.perf_counter() - started) * 1e3

    def _note(self, frames: Sequence[Frame], timing_ms: dict[str, float], stream: str) -> None:
        for stage, ms in timing_ms.items():
            self._metrics.stages.labels(stage).observe(ms / 1e3)
        for frame in frames:
            self._metrics.frames.labels(stream, frame.codec).inc()


def _samples() -> Iterator[Image]:
    pixels: dict[Modality, NDArray[Any]] = {
        "rgb": np.zeros((16, 16, 3), np.uint8),
        "depth": np.zeros((16, 16), np.float32),
        "instance": np.zeros((16, 16), np.uint16),
    }
    for codec in get_args(Codec):
        for modality, values in pixels.items():
            sensor = SensorSpec(camera="warm-up", modalities=[modality], codec=codec)
            yield Image(sensor, modality, 0, np.eye(4), np.eye(3), values)


def _by_options(sensors: Sequence[SensorSpec]) -> dict[RasterOptions, list[int]]:
    """Places of the sensors that can be drawn in one call."""
    groups: dict[RasterOptions, list[int]] = {}
    for i, sensor in enumerate(sensors):
        options = RasterOptions(
            depth="depth" in sensor.modalities, instance="instance" in sensor.modalities
        )
        groups.setdefault(options, []).append(i)
    return groups


def encode(image: Image) -> Frame:
    """The frame of an image; on any thread."""
    encoded = encode_image(
        image.pixels, image.modality, image.sensor.codec, quality=image.sensor.quality
    )
    values: dict[str, Any] = {
        "sensor": image.sensor.camera,
        "modality": image.modality,
        "t_us": image.t_us,
        "T_world_sensor": image.T_world_sensor,
        "K": image.K,
        "codec": encoded.codec,
        "dtype": encoded.dtype,
        "shape": list(encoded.shape),
        "data": encoded.data,
    }
    # Every value is ours; validating a megabyte of pixels again would cost more than sending it.
    return Frame.model_construct(**values)


def check_sensors(
    rig: CameraRig, sensors: Sequence[SensorSpec], *, max_pixels: int
) -> list[Camera]:
    """The cameras of ``sensors`` at the sizes asked for.

    Raises:
        ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels.
    """
    cameras = []
    for sensor in sensors:
        try:
            camera = rig[sensor.camera]
        except SceneError as error:
            raise ServiceError(ErrorCode.UNKNOWN_CAMERA, str(error)) from error
        cameras.append(camera.resized(sensor.width or camera.width))
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
