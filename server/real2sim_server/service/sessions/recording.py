"""Recordings of sessions' episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from real2sim_proto import ErrorCode, encode

from ...world import World
from ...world.mcap_file import cloud_document
from ...world.ranging import MountedLidar, MountedRadar, RangingSensors
from ...world.recording import Recording, record, to_bytes
from ...world.replay import Entry, Replayer, last_episode, no_action_impact
from ..frames import EncodedFrame
from ..http.responses import ServiceError
from .pipeline import EncodedObservation, StepPipeline
from .registry import Sessions
from .session import EpisodeStart, Session

RECORDING = "application/vnd.real2sim.episode"

MAX_FRAMES_BYTES = 512 * 1024 * 1024


async def recording_of(sessions: Sessions, session: Session, *, frames: bool) -> bytes:
    """The recording of the current episode, replayed from the session's log.

    Args:
        sessions: registry with the log.
        session: the session.
        frames: whether to render its sensors again; raw images are stored as png.

    Raises:
        ServiceError: NOT_RESET, or PAYLOAD_TOO_LARGE for more than 512 MiB of images.
    """
    recording, entries = await _replayed(sessions, session)
    if frames:
        drawn = await _frames(sessions.pipeline, session.start, entries)
        recording = replace(recording, frames=drawn)
    return await sessions.pipeline.on_world_thread(to_bytes, recording)


async def episode_of(sessions: Sessions, session: Session) -> Recording:
    """The current episode so far, without images.

    Raises:
        ServiceError: NOT_RESET.
    """
    return (await _replayed(sessions, session))[0]


async def _replayed(sessions: Sessions, session: Session) -> tuple[Recording, list[Entry]]:
    session.running_world()
    entries = last_episode(await sessions.entries(session))
    start, row = session.start, session.row

    def made() -> Recording:
        world = session.running_world()
        impact = None
        if world.accumulator.first_impact is not None:
            impact = no_action_impact(Replayer.on(start.scene, start.state), entries)
        scenario = (
            (row.scenario_id, row.scenario_revision)
            if row.scenario_id is not None and row.scenario_revision is not None
            else None
        )
        return record(
            Replayer.on(start.scene, start.state),
            entries,
            scene_hash=row.scene_hash,
            scenario=scenario,
            state=start.state if scenario is not None else None,
            no_action_impact=impact,
        )

    return await sessions.pipeline.on_world_thread(made), entries


async def _frames(
    pipeline: StepPipeline, start: EpisodeStart, entries: Iterable[Entry]
) -> Mapping[str, bytes]:
    replayer, images, total = Replayer.on(start.scene, start.state), dict[str, bytes](), 0
    for entry in entries:
        world = await pipeline.on_world_thread(replayer.apply, entry)
        if entry.kind not in {"reset", "action"}:
            continue
        shown = await _drawn(pipeline, world)
        if shown is None:
            continue
        for frame in shown.frames:
            images[_name(frame, world.steps)] = bytes(frame.data)
            total += len(frame.data)
        for cloud in shown.clouds:
            packed = encode(cloud_document(cloud))
            images[f"frames/{cloud.sensor}/{cloud.modality}/{world.steps:06d}.cloud"] = packed
            total += len(packed)
        if total > MAX_FRAMES_BYTES:
            raise ServiceError(
                ErrorCode.PAYLOAD_TOO_LARGE,
                f"the images of {world.steps} steps take more than {MAX_FRAMES_BYTES} bytes",
                hint="record without frames and draw them later: real2sim replay --frames",
            )
    return images


async def _drawn(pipeline: StepPipeline, world: World) -> EncodedObservation | None:
    """The observation of the due sensors; None if none is due."""
    sensors = [
        s.model_copy(update={"codec": "png"}) if s.codec == "raw" else s
        for s in world.due_sensors()
    ]
    due = world.due_ranging()
    ranging = RangingSensors(
        tuple(m for m in due if isinstance(m, MountedLidar)),
        tuple(m for m in due if isinstance(m, MountedRadar)),
    )
    return await pipeline.view(world, sensors, ranging=ranging) if sensors or due else None


def _name(frame: EncodedFrame, step: int) -> str:
    suffix = "jpg" if frame.codec == "jpeg" else "png"
    fields = frame.header.fields
    return f"frames/{fields['sensor']}/{fields['modality']}/{step:06d}.{suffix}"
