"""An instant on its way to whoever gets it: seen, rendered, encoded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from real2sim_proto.episode import SensorSpec

from ..._records import made_quickly
from ...scene import Camera
from ...world import World
from ...world.ranging import Cloud
from ..rendering.clouds import cloud_parts
from ..rendering.frames import EncodedFrame, FrameHeader, RenderedImage, raw_headers
from .segment import FrameSlot
from .wire import EncodedMembers, EncodedMessage, PhaseTimer, pack_members, pack_with_frames

Described = tuple[EncodedMembers, list[FrameHeader] | None]
"""An observation without its images, and the headers of these where all are raw."""


@made_quickly
@dataclass(frozen=True, eq=False)
class RenderedObservation:
    """An instant before its images are encoded.

    Attributes:
        world: at that instant.
        images: in the order of sensors and modalities.
        clouds: of LiDARs, then of radars.
        kind, members: of the message, without frames and timing.
        timer: runs on.
        slot: that raw images of the answer may be written to.
    """

    world: World
    images: Sequence[RenderedImage]
    clouds: Sequence[Cloud]
    kind: str
    members: EncodedMembers
    timer: PhaseTimer
    slot: FrameSlot | None = None


@made_quickly
@dataclass(frozen=True, eq=False)
class EncodedObservation:
    """An instant as a message.

    Attributes:
        world: at that instant; it is not committed by being shown.
        frames: the images of the message.
        message: for all who get it, whole.
        timing_ms: by stage.
        placed: for the client that is answered, where its images lie in shared memory.
        clouds: of the message.
    """

    world: World
    frames: Sequence[EncodedFrame]
    message: EncodedMessage
    timing_ms: Mapping[str, float]
    placed: EncodedMessage | None = None
    clouds: Sequence[Cloud] = ()

    @property
    def answer(self) -> EncodedMessage:
        """For the client that is answered."""
        return self.placed or self.message


def describe(world: World, sensors: Sequence[SensorSpec], cameras: Sequence[Camera]) -> Described:
    """An evaluated world in words; ``sensors`` are due."""
    members = pack_members(world.observe().obs_fields())
    if any(sensor.codec != "raw" for sensor in sensors):
        return members, None
    return members, raw_headers(sensors, cameras, world.T_world_estimate, world.t_us)


def with_frames(
    rendered: RenderedObservation, frames: Sequence[EncodedFrame]
) -> EncodedObservation:
    """The message of an instant, and the one whose images lie in shared memory."""
    kind, members, timer = rendered.kind, rendered.members, rendered.timer
    lying = rendered.slot.place(frames) if rendered.slot is not None else None
    timer.stage("encode")
    clouds = [cloud_parts(cloud) for cloud in rendered.clouds]
    message = pack_with_frames(kind, members, frames, timer, clouds=clouds)
    placed = None
    if lying is not None:
        placed = pack_with_frames(kind, members, lying, timer, clouds=clouds)
    return EncodedObservation(
        rendered.world, frames, message, timer.timing_ms, placed, rendered.clouds
    )
