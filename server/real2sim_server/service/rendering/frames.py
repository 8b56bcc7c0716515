"""Images as frames of the wire: the one place where an image becomes bytes.

A frame is a msgpack map whose last member is ``data``; all before it is its header.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from real2sim_proto import encode
from real2sim_proto.episode import SensorSpec

from ...render.images import JpegEncoder, turbo_jpeg
from ...render.modalities import encode_image
from ...scene import Camera
from .optics import frame_names

Part = bytes | memoryview
"""Bytes of a message, sent as they lie in memory."""


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """One rendered image on its way into a frame.

    Attributes:
        sensor: that it was rendered for.
        modality: name of a registered one.
        t_us: instant [us].
        T_world_sensor: [4, 4] float64, camera frame to world.
        K: [3, 3] float64 intrinsics [px].
        pixels: of the dtype and shape of the modality.
        ready: returns when they are there; asked before they are read.
        camera: that it was drawn by.
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
    """A frame up to the bytes of its image.

    Attributes:
        fields: of the wire's Frame, in its order, without ``data``.
        members: those fields, encoded, without a map's header.
        encoded: all of it, and the beginning of ``data``.
    """

    fields: dict[str, Any]
    members: bytes
    encoded: bytes


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """One image, encoded.

    Attributes:
        header: everything but its bytes.
        data: its bytes.
    """

    header: FrameHeader
    data: Part

    @property
    def codec(self) -> str:
        """``raw``, ``jpeg`` or ``png``."""
        return str(self.header.fields["codec"])

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the decoded image."""
        return tuple(self.header.fields["shape"])

    @property
    def fields(self) -> dict[str, Any]:
        """Of the wire's Frame, ``data`` as bytes among them."""
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
    """The frame of an image that lies in shared memory, ``offset`` bytes from its beginning."""
    fields, members = frame.header.fields, frame.header.members
    place = OFFSET + _UINT64 + offset.to_bytes(8, "big")
    encoded = map_header(len(fields) + 2) + members + place + DATA + _bin_header(0)
    return EncodedFrame(FrameHeader(fields, members, encoded), b"")


@functools.cache
def map_header(members: int) -> bytes:
    """Of a msgpack map."""
    header: bytes = msgpack.Packer().pack_map_header(members)
    return header


@functools.cache
def array_header(items: int) -> bytes:
    """Of a msgpack array."""
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
    """A msgpack map of ``fields`` and ``data``, the latter one after the other, in parts."""
    header = map_header(len(fields) + 1) + pack_pairs(fields) + DATA
    return [header + _bin_header(sum(len(part) for part in data)), *data]


def _bin_header(length: int) -> bytes:
    # Always of 32 bits, which msgpack's own packer writes for large values only.
    return b"\xc6" + length.to_bytes(4, "big")


DATA: bytes = msgpack.packb("data")
OFFSET: bytes = msgpack.packb("offset")
_UINT64 = b"\xcf"
