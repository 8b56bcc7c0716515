"""Server messages as bytes, images joined in without a copy on the way."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np

from real2sim_proto import PROTOCOL_VERSION, encode

from ...render import encode_image
from ..pictures import Image

Part = bytes | memoryview
FIXMAP = 16
FRAMES, DATA = (msgpack.packb(name) for name in ("frames", "data"))
RAW_NAMES = {np.dtype(name).newbyteorder("<"): name for name in ("uint8", "uint16", "float32")}
"""Names of the dtypes of raw images; NumPy takes longer to tell them."""


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
        parts: everything behind it; views of images among them.
    """

    head: bytes
    parts: tuple[Part, ...]

    def with_id(self, message_id: int = 0) -> bytes:
        """The whole message; the only copy that an image makes."""
        return b"".join((self.head, _packed(message_id), *self.parts))


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """One image, encoded.

    Attributes:
        fields: of the wire's Frame, without ``data``.
        data: its bytes.
    """

    fields: dict[str, Any]
    data: Part

    @property
    def codec(self) -> str:
        """``raw``, ``jpeg`` or ``png``."""
        return str(self.fields["codec"])


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

    What it takes to join the parts is not in ``timing``, for it happens when a message is sent.
    """
    parts: list[Part] = [members.encoded, FRAMES, _array_header(len(frames))]
    for frame in frames:
        pairs = _map_header(len(frame.fields) + 1) + _pairs(frame.fields) + DATA
        parts += [pairs, _bin_header(len(frame.data)), frame.data]
    watch.stage("pack")
    parts.append(_pairs({"timing": watch.timing_ms}))
    return Message(_head(kind, members.count + 2), tuple(parts))


def encode_frame(image: Image) -> EncodedFrame:
    """The frame of an image; raw ones are views of its pixels. On any thread."""
    fields: dict[str, Any] = {
        "sensor": image.sensor.camera,
        "modality": image.modality,
        "t_us": image.t_us,
        "T_world_sensor": image.T_world_sensor,
        "K": image.K,
    }
    if image.sensor.codec == "raw":
        pixels = np.ascontiguousarray(image.pixels, dtype=image.pixels.dtype.newbyteorder("<"))
        form = {"codec": "raw", "dtype": RAW_NAMES[pixels.dtype], "shape": list(pixels.shape)}
        return EncodedFrame(fields | form, pixels.data.cast("B"))
    encoded = encode_image(
        image.pixels, image.modality, image.sensor.codec, quality=image.sensor.quality
    )
    form = {"codec": encoded.codec, "dtype": encoded.dtype, "shape": list(encoded.shape)}
    return EncodedFrame(fields | form, encoded.data)


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
