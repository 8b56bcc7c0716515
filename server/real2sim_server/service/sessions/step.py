"""From one committed instant to the next, and to the bytes that show it.

A change is made on a light copy of the world. While that is drawn, the change is written ahead to
the session's log; it takes effect once its observation is encoded and packed. Whatever goes wrong
before leaves the session as it was, and what is in its log already is withdrawn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from real2sim_proto import ErrorCode
from real2sim_proto.drive import Agent
from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import Operation

from ...edit import EditOutcome
from ...scene import Camera
from ...world import Event, Plan, World
from ...world.recording.replay import (
    KEPT_PLAN,
    action_payload,
    agent_payload,
    edit_payload,
    name_payload,
    reset_payload,
    stop_payload,
)
from ..http.problems import ServiceError
from ..storage.store import SessionEntry, Store, now_us
from .observation_renderer import EncodedObservation, ObservationRenderer, Tell
from .session import Session
from .wire import Message

Thing = tuple[str, int, bytes]
"""Kind, step and payload of an entry of a session's log."""

MAX_SNAPSHOTS = 32

STEPS_AT_ONCE = 20
"""Steps of a REST request that are computed in one go; other sessions get their turn between."""


class Stepper:
    """Moves the worlds of sessions; for whoever holds the session's lock.

    Args:
        show: makes observations of instants.
        store: takes the logs of the sessions.
    """

    def __init__(self, show: ObservationRenderer, store: Store) -> None:
        self._show = show
        self._store = store

    async def reset(self, session: Session, spec: ResetSpec) -> Message:
        """Begin an episode; its first observation.

        Raises:
            WorldError, ServiceError: the episode cannot run as asked; the running one goes on.
        """
        cameras = self._show.cameras(session.start.scene, spec.sensors)
        thing = ("reset", 0, reset_payload(spec))
        shown = await self._show_and_record(session, _beginning(session, spec), cameras, thing)
        session.begin(shown.world, cameras)
        session.publish(shown.message)
        return shown.message

    async def restart(self, session: Session, spec: ResetSpec) -> None:
        """Begin an episode of which nobody needs the first observation. Raises like reset()."""
        cameras = self._show.cameras(session.start.scene, spec.sensors)
        world = await self._show.on_world_thread(_beginning(session, spec))
        await self._record(session, [("reset", 0, reset_payload(spec))])
        session.begin(world, cameras)

    async def begin(self, session: Session, spec: ResetSpec) -> None:
        """Like restart(), for a session that is not in the store yet: record it once it is."""
        cameras = self._show.cameras(session.start.scene, spec.sensors)
        world = await self._show.on_world_thread(_beginning(session, spec))
        session.begin(world, cameras)

    async def record_beginning(self, session: Session) -> None:
        """Put the episode of a new session on record, if it has one."""
        if session.world is not None:
            await self._record(session, [("reset", 0, reset_payload(session.spec))])

    async def act(
        self,
        session: Session,
        plan: Plan | None,
        payload: bytes,
        *,
        latency_us: int = 0,
        tell: Tell | None = None,
    ) -> Message:
        """Take the action that is due; the next observation.

        Args:
            session: its lock step wants this action now.
            plan: what the ego does.
            payload: canonical bytes of the plan.
            latency_us: wall-clock time from the observation to this action.
            tell: may get the observation before it is returned, see
                :meth:`ObservationRenderer.observe`.

        Raises:
            WorldError: the plan is refused.
            QueueFullError: too much waits for the engine; the same action may be sent again.
        """
        measured = session.spec.latency.model == "measured"
        told = {"latency_us": latency_us if measured else 0, "missed": session.late}
        recorded = action_payload(plan, **told) if any(told.values()) else payload
        shown = await self._step(
            session, lambda world: world.move(plan, **told), recorded, tell=tell
        )
        session.lockstep.advance(payload, shown.message, over=shown.world.over)
        return shown.message

    async def miss(self, session: Session) -> Message:
        """Go on without the action that is due, by the episode's fallback; what to tell.

        Whoever sends that action later is told that it is stale.
        """
        recorded = action_payload(None, missed=True)
        shown = await self._step(session, lambda world: world.move(missed=True), recorded)
        session.lockstep.skip(1, over=shown.world.over)
        return shown.message

    async def stop(self, session: Session, reason: str) -> Message:
        """End the episode where it is; the present observation with the reason."""
        now = session.running_world()

        def stopped() -> World:
            world = now.fork()
            world.stop(reason)
            return world

        thing = ("stop", now.steps, stop_payload(reason))
        shown = await self._show_and_record(session, stopped, session.cameras, thing)
        session.world = shown.world
        session.lockstep.end()
        session.publish(shown.message)
        return shown.message

    async def _step(
        self,
        session: Session,
        move: Callable[[World], None],
        payload: bytes,
        *,
        tell: Tell | None = None,
    ) -> EncodedObservation:
        now = session.running_world()

        def moved() -> World:
            world = now.fork()
            move(world)
            return world

        thing = ("action", now.steps, payload)
        shown = await self._show_and_record(session, moved, session.cameras, thing, tell=tell)
        session.world, session.late = shown.world, False
        session.publish(shown.message)
        return shown

    async def step(self, session: Session, n: int, plan: Plan | None) -> None:
        """Move the clock ``n`` times under one plan, or to the end; nothing is drawn.

        Raises:
            WorldError: the plan is refused, or the episode is over already.
        """
        given, left = plan, n
        while left and (left == n or not session.running_world().over):
            now = session.running_world()
            count = min(STEPS_AT_ONCE, left)
            world, events = await self._show.on_world_thread(_moved_on(now, count, given))
            done = world.steps - now.steps
            payloads = [action_payload(given), *[KEPT_PLAN] * (done - 1)]
            entries = [("action", now.steps + k, p) for k, p in enumerate(payloads)]
            await self._record(session, entries)
            session.world = world
            session.events += events
            session.lockstep.skip(done, over=world.over)
            given, left = None, left - done

    async def edit(
        self, session: Session, operations: Sequence[Operation], *, base_rev: int | None
    ) -> EditOutcome:
        """Edit the world before its next step. Raises EditError; then nothing has changed."""
        now = session.running_world()

        def edited() -> tuple[World, EditOutcome]:
            world = now.fork()
            return world, world.apply(operations, base_revision=base_rev)

        world, outcome = await self._show.on_world_thread(edited)
        await self._record(session, [("edit", now.steps, edit_payload(operations))])
        session.world = world
        return outcome

    async def steer(self, session: Session, asked: Agent) -> None:
        """Give an externally driven object a plan. Raises WorldError."""
        now = session.running_world()

        def steered() -> World:
            world = now.fork()
            world.set_agent_plan(asked.object_id, asked.times_us, asked.poses)
            return world

        world = await self._show.on_world_thread(steered)
        payload = agent_payload(asked.object_id, asked.times_us, asked.poses)
        await self._record(session, [("agent", now.steps, payload)])
        session.world = world

    async def snapshot(self, session: Session, name: str) -> World:
        """Keep the present instant under a name. Raises ServiceError: INVALID_REQUEST."""
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

    async def restore(self, session: Session, name: str) -> Message:
        """Go back to a snapshot; its observation.

        Raises:
            ServiceError: NOT_FOUND.
        """
        kept = session.snapshots.get(name)
        if kept is None:
            named = ", ".join(sorted(session.snapshots)) or "none"
            raise ServiceError(
                ErrorCode.NOT_FOUND,
                f"the session has no snapshot {name!r}",
                hint=f"snapshots of this session: {named}",
            )
        cameras = self._show.cameras(kept.scene, kept.spec.sensors)
        thing = ("restore", kept.steps, name_payload(name))
        shown = await self._show_and_record(session, lambda: kept, cameras, thing)
        session.begin(kept, cameras)
        session.lockstep.reset(kept.steps, over=kept.over)
        session.publish(shown.message)
        return shown.message

    async def _show_and_record(
        self,
        session: Session,
        change: Callable[[], World],
        cameras: Mapping[str, Camera],
        thing: Thing,
        *,
        tell: Tell | None = None,
    ) -> EncodedObservation:
        entries = _entries(session, [thing])
        recorded = False

        def settle(world: World) -> None:
            nonlocal recorded
            world.evaluate()
            self._store.record(session.session_id, entries)
            recorded = True

        try:
            shown = await self._show.observe(change, cameras, settle=settle, tell=tell)
        except Exception:
            if recorded:
                await self._store.withdraw(session.session_id, from_seq=session.next_seq)
            raise
        session.next_seq += len(entries)
        return shown

    async def _record(self, session: Session, things: Sequence[Thing]) -> None:
        entries = _entries(session, things)
        await self._store.append_session_entries(session.session_id, entries)
        session.next_seq += len(entries)


def _entries(session: Session, things: Sequence[Thing]) -> list[SessionEntry]:
    created_us = now_us()
    return [
        SessionEntry(session.next_seq + k, kind, step, payload, created_us)
        for k, (kind, step, payload) in enumerate(things)
    ]


def _beginning(session: Session, spec: ResetSpec) -> Callable[[], World]:
    start = session.start
    return lambda: World(start.scene, start.state, spec)


def _moved_on(now: World, count: int, plan: Plan | None) -> Callable[[], tuple[World, list[Event]]]:
    def move() -> tuple[World, list[Event]]:
        world = now.fork()
        events = world.step(plan)
        while world.steps < now.steps + count and not world.over:
            events += world.step()
        return world, events

    return move
