"""A session's step from one committed world to the next, and to its encoded observation.

A change is made on a fork of the world and runs through the step pipeline (`pipeline`), which first
writes it to the session's log. It takes effect once its observation is encoded and packed. If
anything fails before that, the session stays unchanged and the log entry is withdrawn.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from functools import partial

from real2sim_proto import ErrorCode
from real2sim_proto.drive import Agent
from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import Operation

from ...edit import EditOutcome
from ...scene import Camera
from ...world import Event, Plan, World
from ...world.replay import (
    KEPT_PLAN,
    action_payload,
    agent_payload,
    edit_payload,
    name_payload,
    reset_payload,
    stop_payload,
)
from ..clock import now_us
from ..http.responses import ServiceError
from ..storage.connection import FencedError, StoreTroubleError, StoreUnavailableError
from ..storage.store import SessionEntry, Store, StoredReply
from ..warm_up import KernelWarmUp
from .pipeline import EncodedObservation, LogWrite, Step, StepPipeline
from .sensors import mount_sensors
from .session import NewestPlan, Session
from .shared_memory import FrameSlot
from .wire import EncodedMessage

LogRecord = tuple[str, int, bytes]
"""Kind, step and payload of an entry of a session's log."""

MakeReply = Callable[[World, Sequence[Event]], StoredReply | None]
"""Creates the reply that is stored under a request's key, from the new world and its events."""

MakeEditReply = Callable[[World, EditOutcome], StoredReply | None]
"""Creates the stored reply to an edit, from the edited world and the outcome."""

MAX_SNAPSHOTS = 32

STEPS_AT_ONCE = 20
"""Steps of a REST request computed in one batch; other sessions run in between."""


class Stepper:
    """Advances the worlds of sessions; the caller holds the session's lock.

    Args:
        pipeline: computes observations of changed worlds.
        kernels: kernels that episodes wait for.
        store: stores the logs of the sessions.
        on_fenced: called with a session that belongs to another worker.
    """

    def __init__(
        self,
        pipeline: StepPipeline,
        kernels: KernelWarmUp,
        store: Store,
        *,
        on_fenced: Callable[[Session], object] = lambda _: None,
    ) -> None:
        self._pipeline = pipeline
        self._kernels = kernels
        self._store = store
        self._on_fenced = on_fenced

    async def reset(
        self, session: Session, spec: ResetSpec, *, slot: FrameSlot | None = None
    ) -> EncodedMessage:
        """Start an episode; returns its first observation, with raw images in the slot if given.

        Raises:
            WorldError, ServiceError: the episode cannot run with these options; the current one
                continues.
        """
        cameras = await self._announced(session, spec)
        record = ("reset", 0, reset_payload(spec))
        clouds = bool(spec.lidars or spec.radars)
        step = Step(_beginning(session, spec), cameras, clouds=clouds, slot=slot)
        observation = await self._observe(session, step, record)
        session.begin(observation.world, cameras)
        session.publish(observation.message)
        return observation.answer

    async def restart(self, session: Session, spec: ResetSpec, *, reply: MakeReply) -> None:
        """Start an episode without rendering its first observation. Raises like reset().

        ``reply`` creates the reply that is stored with it.
        """
        cameras = await self._announced(session, spec)
        world = await self._pipeline.on_world_thread(_beginning(session, spec))
        stored = await asyncio.to_thread(reply, world, ())
        await self._record(session, [("reset", 0, reset_payload(spec))], reply=stored)
        session.begin(world, cameras)

    async def begin(self, session: Session, spec: ResetSpec) -> None:
        """Like restart(), for a session that is not yet stored; see beginning_entries()."""
        cameras = await self._announced(session, spec)
        world = await self._pipeline.on_world_thread(_beginning(session, spec))
        session.begin(world, cameras)

    async def _announced(self, session: Session, spec: ResetSpec) -> dict[str, Camera]:
        """Cameras of an episode, once everything that its steps would wait for is ready."""
        start = session.start
        cameras = self._pipeline.cameras(start.scene, spec.sensors)
        ranging = await mount_sensors(spec.lidars, spec.radars, spec.dt_us)
        await self._pipeline.ranging_ready(ranging, spec.sensors, cameras)
        await self._kernels.ready(spec)
        await self._pipeline.levels_ready(start.scene, start.state, spec.sensors, cameras)
        return cameras

    def beginning_entries(self, session: Session) -> list[SessionEntry]:
        """Log of a session that is not yet stored: its first episode, if any."""
        if session.world is None:
            return []
        return _entries(session, [("reset", 0, reset_payload(session.spec))])

    async def act(
        self,
        session: Session,
        plan: Plan | None,
        payload: bytes,
        *,
        waited_us: int = 0,
        slot: FrameSlot | None = None,
    ) -> EncodedMessage:
        """Take the due action; returns the next observation.

        Args:
            session: its lockstep expects this action.
            plan: plan of the ego.
            payload: canonical bytes of the plan.
            waited_us: wall-clock time from the observation to this action.
            slot: shared memory slot for raw images.

        Raises:
            WorldError: the plan is refused.
            QueueFullError: the engine's queue is full. The same action may be sent again.
        """
        now = session.running_world()
        if plan is not None:
            session.newest_plan = NewestPlan(plan, now.motion, waited_us)
        latency_us = waited_us if session.spec.latency.model == "measured" else 0
        entry = payload
        if latency_us or session.late:
            entry = action_payload(plan, latency_us=latency_us, missed=session.late)
        change = partial(_moved, now, plan, latency_us, session.late)
        observation = await self._move(session, change, entry, slot=slot)
        # A repeated answer includes its images, because the slot may hold others by then.
        session.lockstep.advance(payload, observation.message, over=observation.world.over)
        return observation.answer

    async def step_without_action(self, session: Session) -> EncodedMessage:
        """Advance without the due action, by the episode's fallback; returns the observation.

        The due action becomes stale.
        """
        change = partial(_moved, session.running_world(), None, 0, True)
        entry = action_payload(None, missed=True)
        observation = await self._move(session, change, entry)
        session.lockstep.skip(1, over=observation.world.over)
        return observation.message

    async def stop(self, session: Session, reason: str) -> EncodedMessage:
        """End the episode at its newest step; returns its observation with the reason."""
        now = session.running_world()
        record = ("stop", now.steps, stop_payload(reason))
        step = Step(partial(_stopped, now, reason), session.cameras, clouds=bool(now.ranging))
        observation = await self._observe(session, step, record)
        session.world = observation.world
        session.lockstep.end()
        session.publish(observation.message)
        return observation.message

    async def _move(
        self,
        session: Session,
        change: Callable[[], World],
        payload: bytes,
        *,
        slot: FrameSlot | None = None,
    ) -> EncodedObservation:
        """Advance the clock by one step."""
        now = session.running_world()
        step = Step(
            change,
            session.cameras,
            clouds=bool(now.ranging),
            slot=slot,
            drawn_with=self._pipeline.drawn_with(now, session.cameras),
        )
        observation = await self._observe(session, step, ("action", now.steps, payload))
        session.world, session.late = observation.world, False
        session.publish(observation.message)
        return observation

    async def step(self, session: Session, n: int, plan: Plan | None, *, reply: MakeReply) -> None:
        """Advance the clock by ``n`` steps under one plan, or to the end, without rendering.

        All steps take effect, or none. ``reply`` creates the reply that is stored with them.

        Raises:
            WorldError: the plan is refused, or the episode has already ended.
        """
        now = session.running_world()
        given, world, events = plan, now, list(session.events)
        entries: list[LogRecord] = []
        while not entries or (world.steps < now.steps + n and not world.over):
            count, before = min(STEPS_AT_ONCE, now.steps + n - world.steps), world.steps
            world, happened = await self._pipeline.on_world_thread(_moved_on, world, count, given)
            done = world.steps - before
            payloads = [action_payload(given), *[KEPT_PLAN] * (done - 1)]
            entries += [("action", before + k, p) for k, p in enumerate(payloads)]
            events, given = events + happened, None
        stored = await asyncio.to_thread(reply, world, events)
        await self._record(session, entries, reply=stored)
        session.world, session.events = world, events
        session.lockstep.skip(world.steps - now.steps, over=world.over)

    async def edit(
        self,
        session: Session,
        operations: Sequence[Operation],
        *,
        base_rev: int | None,
        reply: MakeEditReply | None = None,
    ) -> EditOutcome:
        """Edit the world before its next step; ``reply`` creates the reply that is stored with it.

        Raises:
            EditError, ServiceError: nothing has changed.
        """
        now = session.running_world()

        def edited() -> tuple[World, EditOutcome]:
            world = now.fork()
            return world, world.apply(operations, base_revision=base_rev)

        world, outcome = await self._pipeline.on_world_thread(edited)
        await self._pipeline.edit_ready(world, session.cameras)
        stored = reply(world, outcome) if reply is not None else None
        await self._record(session, [("edit", now.steps, edit_payload(operations))], reply=stored)
        session.world = world
        return outcome

    async def set_agent_plan(self, session: Session, message: Agent) -> None:
        """Set the plan of an externally driven object. Raises WorldError."""
        now = session.running_world()

        def steered() -> World:
            world = now.fork()
            world.set_agent_plan(message.object_id, message.times_us, message.poses)
            return world

        world = await self._pipeline.on_world_thread(steered)
        payload = agent_payload(message.object_id, message.times_us, message.poses)
        await self._record(session, [("agent", now.steps, payload)])
        session.world = world

    async def snapshot(self, session: Session, name: str) -> World:
        """Save the current state under a name. Raises ServiceError: INVALID_REQUEST."""
        now = session.running_world()
        if name not in session.snapshots and len(session.snapshots) >= MAX_SNAPSHOTS:
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"the session keeps {MAX_SNAPSHOTS} snapshots already",
                hint="use one of their names again",
            )
        await self._record(session, [("snapshot", now.steps, name_payload(name))])
        session.snapshots[name] = now
        return now

    async def restore(self, session: Session, name: str) -> EncodedMessage:
        """Return to a snapshot; returns its observation.

        Raises:
            ServiceError: NOT_FOUND.
        """
        snapshot = session.snapshots.get(name)
        if snapshot is None:
            named = ", ".join(sorted(session.snapshots)) or "none"
            raise ServiceError(
                ErrorCode.NOT_FOUND,
                f"the session has no snapshot {name!r}",
                hint=f"snapshots of this session: {named}",
            )
        cameras = self._pipeline.cameras(snapshot.scene, snapshot.spec.sensors)
        record = ("restore", snapshot.steps, name_payload(name))
        step = Step(lambda: snapshot, cameras, clouds=bool(snapshot.ranging))
        observation = await self._observe(session, step, record)
        session.begin(snapshot, cameras)
        session.lockstep.reset(snapshot.steps, over=snapshot.over)
        session.publish(observation.message)
        return observation.message

    async def _observe(self, session: Session, step: Step, entry: LogRecord) -> EncodedObservation:
        """The observation of a change, after the change is stored."""
        entries = _entries(session, [entry])
        step.log = LogWrite(self._store, session.row.claim, entries, session.log_unsure)
        try:
            observation = await self._pipeline.run(step)
        except StoreUnavailableError:
            session.log_unsure = True
            raise
        except FencedError:
            self._on_fenced(session)
            raise
        except Exception:
            if step.recorded:
                await self._withdraw(session)
            raise
        session.next_seq, session.log_unsure = session.next_seq + 1, False
        return observation

    async def _withdraw(self, session: Session) -> None:
        """Withdraw entries of a failed change; if the store fails, do so with the next entry."""
        try:
            await self._store.withdraw(session.row.claim, from_seq=session.next_seq)
        except StoreTroubleError:
            session.log_unsure = True
        except FencedError:
            self._on_fenced(session)

    async def settle(self, session: Session) -> None:
        """Withdraw entries and replies that may be stored but never took effect."""
        if session.log_unsure:
            keys, seq = session.unsure_replies, session.next_seq
            await self._store.withdraw(session.row.claim, from_seq=seq, replies=keys)
            session.log_unsure, session.unsure_replies = False, ()

    async def _record(
        self,
        session: Session,
        records: Sequence[LogRecord],
        *,
        reply: StoredReply | None = None,
    ) -> None:
        entries = _entries(session, records)
        try:
            await self._store.append_session_entries(
                session.row.claim, entries, instead=session.log_unsure, reply=reply
            )
        except StoreUnavailableError:
            session.log_unsure = True
            if reply is not None:
                session.unsure_replies += (reply.key,)
            raise
        except FencedError:
            self._on_fenced(session)
            raise
        session.next_seq, session.log_unsure = session.next_seq + len(entries), False


def _entries(session: Session, records: Sequence[LogRecord]) -> list[SessionEntry]:
    created_us = now_us()
    return [
        SessionEntry(session.next_seq + k, kind, step, payload, created_us)
        for k, (kind, step, payload) in enumerate(records)
    ]


def _beginning(session: Session, spec: ResetSpec) -> Callable[[], World]:
    start = session.start
    return lambda: World(start.scene, start.state, spec)


def _moved(now: World, plan: Plan | None, latency_us: int, missed: bool) -> World:
    world = now.fork()
    world.move(plan, latency_us=latency_us, missed=missed)
    return world


def _stopped(now: World, reason: str) -> World:
    world = now.fork()
    world.stop(reason)
    return world


def _moved_on(now: World, count: int, plan: Plan | None) -> tuple[World, list[Event]]:
    world = now.fork()
    events = world.step(plan)
    while world.steps < now.steps + count and not world.over:
        events += world.step()
    return world, events
