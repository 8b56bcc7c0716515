"""Sessions that an earlier run of the worker left open, rebuilt from their logs."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence

from real2sim_proto import ErrorCode, decode
from real2sim_proto.plans import PLAN

from ...edit import LogEntry, Scenario, ScenarioState
from ...scene import Camera
from ...world import World
from ...world.recording.replay import Entry, Replayer, plan_payload
from ..http.problems import ServiceError
from ..scenarios.scenarios import Scenarios
from ..storage.store import SessionEntry, SessionRow, Store
from .pipeline import Step, StepPipeline
from .session import Session


def entries_of(rows: Iterable[SessionEntry]) -> list[Entry]:
    """Entries of a stored log, for the world to live through again."""
    return [Entry(row.kind, row.step or 0, row.payload) for row in rows]


async def rebuild(session: Session, *, store: Store, pipeline: StepPipeline) -> None:
    """Make a new session what it was when its last entry took effect.

    Everything is replayed without rendering but the last step, whose answer its client may never
    have got: it is rendered, so that the same action sent again gets it.

    Args:
        session: at its beginning, its scene pinned.
        store: has its log.
        pipeline: moves worlds and draws.
    """
    start = session.start
    rows = await store.session_entries(session.session_id)
    session.next_seq = rows[-1].seq + 1 if rows else 0
    entries = entries_of(rows)
    if not entries:
        return
    replayer = Replayer.on(start.scene, start.state)
    *before, last = entries
    await pipeline.on_world_thread(_apply_all, replayer, before)
    session.snapshots = replayer.snapshots
    if last.kind == "action":
        before_last = _world(replayer)
        cameras = await _cameras_ready(pipeline, session, before_last)
        clouds = bool(before_last.ranging)
        observation = await pipeline.run(Step(lambda: replayer.apply(last), cameras, clouds=clouds))
        session.begin(observation.world, cameras)
        session.lockstep.reset(observation.world.steps, over=observation.world.over)
        if not decode(last.payload).get("missed"):
            session.lockstep.restore_answer(_content(last), observation.message)
        session.newest = observation.message
        return
    world = await pipeline.on_world_thread(replayer.apply, last)
    session.begin(world, await _cameras_ready(pipeline, session, world))
    session.lockstep.reset(world.steps, over=world.over)


async def _cameras_ready(
    pipeline: StepPipeline, session: Session, world: World
) -> dict[str, Camera]:
    """Cameras of an episode, once all that its observations would wait for is there."""
    start, sensors = session.start, world.spec.sensors
    cameras = pipeline.cameras(start.scene, sensors)
    await pipeline.ranging_ready(world.ranging, sensors, cameras)
    await pipeline.levels_ready(start.scene, start.state, sensors, cameras)
    return cameras


async def state_at(scenarios: Scenarios, scenario_id: str, revision: int) -> ScenarioState:
    """Objects of a scenario as they were at a revision.

    Raises:
        ServiceError: UNKNOWN_SCENARIO where it was deleted.
    """
    view = await scenarios.view(scenario_id)
    if view.revision == revision:
        return view.state
    history = await scenarios.history(scenario_id)

    def replayed() -> ScenarioState:
        scenario = Scenario.replay(
            ScenarioState.of(view.summary, assets=view.state.assets),
            [
                LogEntry(e.revision, e.kind, tuple(e.operations), e.target, e.created_at, e.who)
                for e in history.entries[:revision]
            ],
            scene=view.row.scene,
            scene_hash=view.row.scene_hash,
        )
        return scenario.state

    return await asyncio.to_thread(replayed)


def check_scene(row: SessionRow, scene_hash: str) -> None:
    """Raises ServiceError: SCENE_BROKEN when the scene is not the one the session ran on."""
    if row.scene_hash != scene_hash:
        raise ServiceError(
            ErrorCode.SCENE_BROKEN,
            f"session {row.session_id!r} ran on scene {row.scene!r} with hash "
            f"{row.scene_hash[:12]}; it has {scene_hash[:12]} now",
            hint="put the old bundle back, or make a new session",
        )


def _apply_all(replayer: Replayer, entries: Sequence[Entry]) -> None:
    for entry in entries:
        replayer.apply(entry)


def _world(replayer: Replayer) -> World:
    assert replayer.world is not None
    return replayer.world


def _content(entry: Entry) -> bytes:
    """What an action is compared by: its plan alone, as this version writes it. The version that
    wrote the entry may not have known all of its members."""
    fields = decode(entry.payload)["plan"]
    return plan_payload(None if fields is None else PLAN.validate_python(fields))
