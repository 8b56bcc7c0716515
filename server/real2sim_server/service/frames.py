"""Images and point clouds as protocol bytes, and the optics of sensors.

A frame is a msgpack map whose last member is ``data``; the members before it are its header.
"""

from __future__ import annotations

import functools
import threading
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from real2sim_proto import encode
from real2sim_proto.episode import SensorSpec
from real2sim_proto.sensors import LensSpec, MotionBlurSpec, Optics

from ..geometry import Float
from ..render import Instance, RigView
from ..render.images import JpegEncoder, Light, to_display, to_light, turbo_jpeg
from ..render.modalities import encode_image
from ..scene import Camera, Lens, Shutter
from ..scene.camera import moved
from ..scene.lens import lens_from
from ..world.ranging import Cloud

# --- Optics --------------------------------------------------------------------------------------


def camera_with(camera: Camera, optics: Optics) -> Camera:
    """A camera of a rig with the optics of a sensor. Raises SceneError for invalid optics."""
    if optics == "pinhole":
        return camera
    if optics == "recorded":
        return camera.as_recorded()
    K = camera.K if optics.K is None else np.array(optics.K)
    shutter = Shutter(optics.shutter.direction, optics.shutter.readout_us)
    return replace(camera, K=K, lens=lens_of(optics.lens), shutter=shutter, recorded=None)


def lens_of(spec: LensSpec) -> Lens | None:
    """The lens of a spec. Raises SceneError for invalid parameters."""
    return lens_from(spec.model_dump())


def needs_motion(sensors: Sequence[SensorSpec]) -> bool:
    """Whether images of the sensors depend on velocities, and not only on poses."""
    return any(sensor.optics != "pinhole" or sensor.effects is not None for sensor in sensors)


def frame_names(sensor: SensorSpec, camera: Camera | None, modality: str) -> dict[str, Any]:
    """Lens, shutter and effects of a frame; empty if it has none."""
    said: dict[str, Any] = {}
    if camera is not None and camera.lens is not None:
        said["lens"] = camera.lens.model
    if camera is not None and camera.shutter.rolls:
        said["shutter"] = camera.shutter.direction
    if modality == "rgb" and sensor.effects is not None and sensor.effects.names:
        said["effects"] = sensor.effects.names
    return said


class FollowingImage:
    """An image computed from a rendered one on demand, on any thread.

    Args:
        drawn: [H, W] or [H, W, 3] uint8; complete after ``wait``.
        wait: waits for the rendered image.
        follow: computes the image, of the same shape; called once, after ``wait``.

    Attributes:
        pixels: like ``drawn``; complete after :meth:`ready`.
    """

    def __init__(
        self,
        drawn: NDArray[np.uint8],
        wait: Callable[[], object],
        follow: Callable[[], NDArray[np.uint8]],
    ) -> None:
        self.pixels = np.empty_like(drawn)
        self._wait = wait
        self._follow: Callable[[], NDArray[np.uint8]] | None = follow
        self._lock = threading.Lock()

    def ready(self) -> None:
        """Wait until the pixels are complete; may be called repeatedly."""
        with self._lock:
            if self._follow is not None:
                self._wait()
                self.pixels[:] = self._follow()
                self._follow = None  # also releases the rendered image


def blurred(
    view: RigView, blur: MotionBlurSpec, draw: Callable[[RigView], NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """Motion blur: the mean linear light of ``blur.samples`` images, evenly spaced in the exposure.

    The exposure is centred on the time of ``view``.

    Args:
        view: view of one camera, with the motion of its vehicle and of the visible objects.
        blur: exposure time and number of samples.
        draw: renders the colour image of a view.
    """
    total: Light | None = None
    for k in range(blur.samples):
        seconds = ((k + 0.5) / blur.samples - 0.5) * blur.exposure_us * 1e-6
        light = to_light(draw(_later(view, seconds)))
        total = light if total is None else total + light
    assert total is not None
    return to_display(total / np.float32(blur.samples))


def _later(view: RigView, seconds: float) -> RigView:
    vehicle: Float = np.asarray(view.T_world_vehicle, dtype=np.float64)
    if view.twist is not None:
        vehicle = moved(vehicle, view.twist[:3], view.twist[3:], seconds)
    instances = [_moved_on(instance, seconds) for instance in view.instances]
    return replace(view, T_world_vehicle=vehicle, instances=instances)


def _moved_on(instance: Instance, seconds: float) -> Instance:
    if instance.twist is None or instance.T_world_object is None:
        return instance
    pose = np.asarray(instance.T_world_object, dtype=np.float64)
    there = moved(pose, instance.twist[:3], instance.twist[3:], seconds)
    return replace(instance, T_world_object=there)


Part = bytes | memoryview
"""Bytes of a message, sent without copying."""


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """A rendered image, before encoding.

    Attributes:
        sensor: its sensor.
        modality: name of a registered modality.
        t_us: time [us].
        T_world_sensor: [4, 4] float64, camera frame to world.
        K: [3, 3] float64 intrinsics [px].
        pixels: dtype and shape depend on the modality.
        ready: waits for the pixels; called before they are read.
        camera: camera of the image.
    """

    sensor: SensorSpec
    modality: str
    t_us: int
    T_world_sensor: NDArray[np.float64]
    K: NDArray[np.float64]
    pixels: NDArray[Any]
    ready: Callable[[], object] = lambda: None
    camera: Camera | None = None


@dataclass(frozen=True, eq=False)
class FrameHeader:
    """A frame without the bytes of its image.

    Attributes:
        fields: members of the protocol's Frame, in order, without ``data``.
        members: the encoded fields, without a map header.
        encoded: the encoded header and the beginning of ``data``.
    """

    fields: dict[str, Any]
    members: bytes
    encoded: bytes


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """One image, encoded.

    Attributes:
        header: the frame without the image's bytes.
        data: bytes of the image.
    """

    header: FrameHeader
    data: Part

    @property
    def codec(self) -> str:
        """``raw``, ``jpeg`` or ``png``."""
        return str(self.header.fields["codec"])

    @property
    def shape(self) -> tuple[int, ...]:
        """Data type of the decoded image."""
        return tuple(self.header.fields["shape"])

    @property
    def fields(self) -> dict[str, Any]:
        """Members of the protocol's Frame, including ``data`` as bytes."""
        return self.header.fields | {"data": bytes(self.data)}


def encode_frame(image: RenderedImage, *, jpeg: JpegEncoder = turbo_jpeg) -> EncodedFrame:
    """The frame of an image; raw ones are views of its pixels. On any thread."""
    image.ready()
    fields = {
        "sensor": image.sensor.camera,
        "modality": image.modality,
        "t_us": image.t_us,
        "T_world_sensor": image.T_world_sensor,
        "K": image.K,
        **frame_names(image.sensor, image.camera, image.modality),
    }
    if image.sensor.codec == "raw":
        pixels = np.ascontiguousarray(image.pixels)
        fields |= {"codec": "raw", "dtype": pixels.dtype.name, "shape": list(pixels.shape)}
        return EncodedFrame(_frame_header(fields, pixels.nbytes), pixels.data.cast("B"))
    encoded = encode_image(
        image.pixels, image.modality, image.sensor.codec, quality=image.sensor.quality, jpeg=jpeg
    )
    fields |= {"codec": encoded.codec, "dtype": encoded.dtype, "shape": list(encoded.shape)}
    return EncodedFrame(_frame_header(fields, len(encoded.data)), encoded.data)


def placed_frame(frame: EncodedFrame, offset: int) -> EncodedFrame:
    """The frame of an image in shared memory, at ``offset`` bytes from its start."""
    fields, members = frame.header.fields, frame.header.members
    place = OFFSET + _UINT64 + offset.to_bytes(8, "big")
    encoded = map_header(len(fields) + 2) + members + place + DATA + _bin_header(0)
    return EncodedFrame(FrameHeader(fields, members, encoded), b"")


@functools.cache
def map_header(members: int) -> bytes:
    """Header of a msgpack map."""
    header: bytes = msgpack.Packer().pack_map_header(members)
    return header


@functools.cache
def array_header(items: int) -> bytes:
    """Header of a msgpack array."""
    header: bytes = msgpack.Packer().pack_array_header(items)
    return header


def pack_pairs(fields: Mapping[str, Any]) -> bytes:
    """The members of a map without its header, to be joined with others into one map."""
    return encode(dict(fields))[len(map_header(len(fields))) :]


def _frame_header(fields: dict[str, Any], size: int) -> FrameHeader:
    members = pack_pairs(fields)
    encoded = map_header(len(fields) + 1) + members + DATA + _bin_header(size)
    return FrameHeader(fields, members, encoded)


def bytes_member(fields: Mapping[str, Any], data: Sequence[Part]) -> list[Part]:
    """A msgpack map of ``fields`` and ``data`` (concatenated), in parts."""
    header = map_header(len(fields) + 1) + pack_pairs(fields) + DATA
    return [header + _bin_header(sum(len(part) for part in data)), *data]


def _bin_header(length: int) -> bytes:
    # Always a 32-bit length; msgpack's packer uses it only for large values.
    return b"\xc6" + length.to_bytes(4, "big")


DATA: bytes = msgpack.packb("data")
OFFSET: bytes = msgpack.packb("offset")
_UINT64 = b"\xcf"


# --- Point clouds --------------------------------------------------------------------------------

DEFLATE_LEVEL = 1
"""Higher levels take three times as long for 10 % less."""


def cloud_parts(cloud: Cloud) -> list[Part]:
    """The protocol's PointCloud, in parts; raw columns are not copied."""
    columns = {name: _little(column) for name, column in cloud.columns.items()}
    fields = {
        "sensor": cloud.sensor,
        "modality": cloud.modality,
        "t_us": cloud.t_us,
        "duration_us": cloud.duration_us,
        "frame": cloud.frame,
        "compensated": cloud.compensated,
        "T_world_sensor": cloud.T_world_sensor,
        "T_vehicle_sensor": cloud.T_vehicle_sensor,
        "count": cloud.count,
        "fields": [_field(name, column) for name, column in columns.items()],
        "codec": cloud.codec,
    }
    if cloud.codec == "deflate":
        data: Sequence[Part] = [deflated(list(columns.values()))]
    else:
        data = [column.data.cast("B") for column in columns.values() if column.size]
    return bytes_member(fields, data)


def deflated(columns: Sequence[NDArray[Any]]) -> bytes:
    """Columns compressed by zlib after a byte shuffle, because high bytes hardly vary.

    The shuffle groups the first bytes of all numbers, then the second bytes, and so on.
    """
    packer = zlib.compressobj(DEFLATE_LEVEL)
    parts = []
    for column in columns:
        planes = column.reshape(-1).view(np.uint8).reshape(-1, column.dtype.itemsize).T
        parts.append(packer.compress(np.ascontiguousarray(planes).tobytes()))
    return b"".join([*parts, packer.flush()])


def _little(column: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("<"))


def _field(name: str, column: NDArray[Any]) -> dict[str, Any]:
    width = column.shape[1] if column.ndim > 1 else 1
    return {"name": name, "dtype": column.dtype.name, "width": width}
