"""Server messages as bytes; images are never copied."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgpack

from real2sim_proto import PROTOCOL_VERSION

from ..._records import made_quickly
from ..frames import EncodedFrame, Part, array_header, map_header, pack_pairs

FRAMES: bytes = msgpack.packb("frames")
CLOUDS: bytes = msgpack.packb("clouds")


@dataclass(eq=False)
class PhaseTimer:
    """Milliseconds by stage; each stage ends where the next one begins."""

    timing_ms: dict[str, float] = field(default_factory=dict)
    _since: float = field(default_factory=time.perf_counter)

    def stage(self, name: str) -> None:
        """End the stage ``name``, which began at the last stage."""
        now = time.perf_counter()
        self.timing_ms[name] = (now - self._since) * 1e3
        self._since = now


@made_quickly
@dataclass(frozen=True, eq=False)
class EncodedMembers:
    """Encoded members of a message.

    Attributes:
        count: number of members.
        encoded: their names and values, without a map header.
    """

    count: int
    encoded: bytes


@made_quickly
@dataclass(frozen=True, eq=False)
class EncodedMessage:
    """An encoded message without its id, so that one encoding serves all recipients.

    Attributes:
        head: bytes before the id.
        rest: bytes after it, including views of images.
    """

    head: bytes
    rest: tuple[Part, ...]

    def parts(self, message_id: int = 0) -> list[Part]:
        """The whole message, in parts to be sent in order."""
        return [self.head + _packed(message_id), *self.rest]

    def joined(self, message_id: int = 0) -> bytes:
        """The whole message in one piece, a copy of all its images."""
        return b"".join(self.parts(message_id))


def pack_members(fields: Mapping[str, Any]) -> EncodedMembers:
    """Members of plain values and arrays."""
    return EncodedMembers(len(fields), pack_pairs(fields))


def pack_message(kind: str, fields: Mapping[str, Any]) -> EncodedMessage:
    """A message of plain values and arrays."""
    members = pack_members(fields)
    return EncodedMessage(_head(kind, members.count), (members.encoded,))


def pack_with_frames(
    kind: str,
    members: EncodedMembers,
    frames: Sequence[EncodedFrame],
    watch: PhaseTimer,
    *,
    clouds: Sequence[Sequence[Part]] = (),
) -> EncodedMessage:
    """A message with members, frames, timing and optional point clouds.

    Each cloud is a map in several parts.

    ``timing`` does not include sending.
    """
    parts: list[Part] = [members.encoded + FRAMES + array_header(len(frames))]
    for frame in frames:
        parts += [frame.header.encoded, frame.data]
    if clouds:
        parts.append(CLOUDS + array_header(len(clouds)))
        for cloud in clouds:
            parts += cloud
    watch.stage("pack")
    parts.append(pack_pairs({"timing": watch.timing_ms}))
    return EncodedMessage(_head(kind, members.count + 2 + bool(clouds)), tuple(parts))


@functools.cache
def _head(kind: str, members: int) -> bytes:
    envelope = pack_pairs({"v": PROTOCOL_VERSION, "type": kind})
    return map_header(members + 3) + envelope + _packed("id")


def _packed(value: str | int) -> bytes:
    packed: bytes = msgpack.packb(value)
    return packed
