"""Server messages as bytes, with images that are never copied on the way."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from real2sim_proto import PROTOCOL_VERSION, encode
from real2sim_proto.base import Modality
from real2sim_proto.drive import SensorSpec

from ...render import encode_image
from ...scene import Camera
from ..http.websocket import Part
from ..rendering.renderer import Image

FIXMAP = 16
FRAMES, DATA = (msgpack.packb(name) for name in ("frames", "data"))
RAW_PIXELS: dict[Modality, tuple[np.dtype[Any], tuple[int, ...]]] = {
    "rgb": (np.dtype(np.uint8), (3,)),
    "depth": (np.dtype("<f4"), ()),
    "instance": (np.dtype("<u2"), ()),
}
"""dtype and shape of one pixel."""


@dataclass(eq=False)
class Stopwatch:
    """Milliseconds by stage; each stage ends where the next one begins."""

    timing_ms: dict[str, float] = field(default_factory=dict)
    _since: float = field(default_factory=time.perf_counter)

    def stage(self, name: str) -> None:
        """What happened since the last stage was ``name``."""
        now = time.perf_counter()
        self.timing_ms[name] = (now - self._since) * 1e3
        self._since = now


@dataclass(frozen=True, eq=False)
class Members:
    """Members of a message, encoded.

    Attributes:
        count: how many.
        encoded: their names and values, without a map's header.
    """

    count: int
    encoded: bytes


@dataclass(frozen=True, eq=False)
class Message:
    """An encoded message that lacks only its id, so that one encoding serves all who get it.

    Attributes:
        head: bytes up to the id.
        rest: everything behind it; views of images among them.
    """

    head: bytes
    rest: tuple[Part, ...]

    def parts(self, message_id: int = 0) -> list[Part]:
        """The whole message, to be sent one part after the other."""
        return [self.head + _packed(message_id), *self.rest]

    def joined(self, message_id: int = 0) -> bytes:
        """The whole message in one piece, a copy of all its images."""
        return b"".join(self.parts(message_id))


@dataclass(frozen=True, eq=False)
class FrameHead:
    """A frame up to the bytes of its image.

    Attributes:
        fields: of the wire's Frame, without ``data``.
        encoded: those fields, and the beginning of ``data``.
    """

    fields: dict[str, Any]
    encoded: bytes


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """One image, encoded.

    Attributes:
        head: everything but its bytes.
        data: its bytes.
    """

    head: FrameHead
    data: Part

    @property
    def codec(self) -> str:
        """``raw``, ``jpeg`` or ``png``."""
        return str(self.head.fields["codec"])


def pack_members(fields: Mapping[str, Any]) -> Members:
    """Members of plain values and arrays."""
    return Members(len(fields), _pairs(fields))


def pack_message(kind: str, fields: Mapping[str, Any]) -> Message:
    """A message of plain values and arrays."""
    members = pack_members(fields)
    return Message(_head(kind, members.count), (members.encoded,))


def pack_with_frames(
    kind: str, members: Members, frames: Sequence[EncodedFrame], watch: Stopwatch
) -> Message:
    """A message with the members ``frames`` and ``timing`` besides ``members``.

    What it takes to send the parts is not in ``timing``, for that comes later.
    """
    parts: list[Part] = [members.encoded + FRAMES + _array_header(len(frames))]
    for frame in frames:
        parts += [frame.head.encoded, frame.data]
    watch.stage("pack")
    parts.append(_pairs({"timing": watch.timing_ms}))
    return Message(_head(kind, members.count + 2), tuple(parts))


def encode_frame(image: Image) -> EncodedFrame:
    """The frame of an image; raw ones are views of its pixels. On any thread."""
    fields = _placed(image.sensor, image.modality, image.t_us, image.T_world_sensor, image.K)
    if image.sensor.codec == "raw":
        return with_pixels(_raw_head(fields, image.pixels.shape[:2]), image.pixels)
    encoded = encode_image(
        image.pixels, image.modality, image.sensor.codec, quality=image.sensor.quality
    )
    fields |= {"codec": encoded.codec, "dtype": encoded.dtype, "shape": list(encoded.shape)}
    return EncodedFrame(_frame_head(fields, len(encoded.data)), encoded.data)


def raw_heads(
    sensors: Sequence[SensorSpec],
    cameras: Sequence[Camera],
    T_world_vehicle: NDArray[np.float64],
    t_us: int,
) -> list[FrameHead]:
    """Heads of the raw images of ``sensors``, which need not be drawn yet.

    Args:
        sensors: S of them.
        cameras: of the sensors, S of them.
        T_world_vehicle: [4, 4], where the cameras' vehicle stands.
        t_us: the instant [us].
    """
    return [
        _raw_head(
            _placed(sensor, modality, t_us, camera.pose(T_world_vehicle), camera.K),
            (camera.height, camera.width),
        )
        for sensor, camera in zip(sensors, cameras, strict=True)
        for modality in sensor.modalities
    ]


def with_pixels(head: FrameHead, pixels: NDArray[Any]) -> EncodedFrame:
    """The frame of a raw image; a view of its pixels.

    Raises:
        TypeError: the image was drawn in another dtype or shape than its head says.
    """
    fields = head.fields
    if list(pixels.shape) != fields["shape"] or pixels.dtype != RAW_PIXELS[fields["modality"]][0]:
        raise TypeError(
            f"an image of {pixels.dtype} {pixels.shape} instead of {fields['dtype']} "
            f"{fields['shape']}"
        )
    return EncodedFrame(head, np.ascontiguousarray(pixels).data.cast("B"))


def raw_bytes(modality: Modality, width: int, height: int) -> int:
    """Of an image of that size."""
    dtype, shape = RAW_PIXELS[modality]
    return width * height * math.prod(shape) * dtype.itemsize


def _placed(
    sensor: SensorSpec,
    modality: Modality,
    t_us: int,
    T_world_sensor: NDArray[np.float64],
    K: NDArray[np.float64],
) -> dict[str, Any]:
    """What a frame says of when and from where."""
    return {
        "sensor": sensor.camera,
        "modality": modality,
        "t_us": t_us,
        "T_world_sensor": T_world_sensor,
        "K": K,
    }


def _raw_head(placed: dict[str, Any], size: tuple[int, ...]) -> FrameHead:
    """Of a raw image of ``size`` (height, width)."""
    modality = placed["modality"]
    dtype, shape = RAW_PIXELS[modality]
    form = {"codec": "raw", "dtype": dtype.name, "shape": [*size, *shape]}
    return _frame_head(placed | form, raw_bytes(modality, size[1], size[0]))


def _frame_head(fields: dict[str, Any], size: int) -> FrameHead:
    packed = _map_header(len(fields) + 1) + _pairs(fields) + DATA + _bin_header(size)
    return FrameHead(fields, packed)


@functools.cache
def _head(kind: str, members: int) -> bytes:
    return _map_header(members + 3) + _pairs({"v": PROTOCOL_VERSION, "type": kind}) + _packed("id")


def _pairs(fields: Mapping[str, Any]) -> bytes:
    """The members of a map without its header, to be joined with others into one map."""
    return encode(dict(fields))[len(_map_header(len(fields))) :]


def _packed(value: str | int) -> bytes:
    packed: bytes = msgpack.packb(value)
    return packed


def _map_header(members: int) -> bytes:
    return bytes([0x80 | members]) if members < FIXMAP else b"\xde" + members.to_bytes(2, "big")


def _array_header(items: int) -> bytes:
    return bytes([0x90 | items]) if items < FIXMAP else b"\xdc" + items.to_bytes(2, "big")


def _bin_header(length: int) -> bytes:
    return b"\xc6" + length.to_bytes(4, "big")
