"""From one committed instant to the next, and to the bytes that show it.

A change is made on a light copy of the world, drawn, encoded and packed, then written to the
session's log, and only then it takes effect. Whatever goes wrong before leaves the session as it
was, and leaves no trace in its log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from real2sim_proto.drive import ResetSpec
from real2sim_proto.operations import Operation

from ...edit import EditOutcome
from ...world import Event, Plan, World
from ..store import SessionEntry, Store, now_us
from .log import KEPT_PLAN, edit_payload, plan_payload, reset_payload
from .session import Session
from .show import Show

STEPS_AT_ONCE = 20
"""Steps of a REST request that are computed in one go; other sessions get their turn between."""


class Stepper:
    """Moves the worlds of sessions; for whoever holds the session's lock.

    Args:
        show: makes observations of instants.
        store: takes the logs of the sessions.
    """

    def __init__(self, show: Show, store: Store) -> None:
        self._show = show
        self._store = store

    async def reset(self, session: Session, spec: ResetSpec, *, reply_to: int) -> bytes:
        """Begin an episode; its first observation, ready to be sent.

        Raises:
            WorldError, ServiceError: the episode cannot run as asked; the running one goes on.
        """
        cameras = self._show.cameras(session.start.scene, spec.sensors)
        shown = await self._show.observe(_beginning(session, spec), cameras, reply_to=reply_to)
        await self._record(session, [("reset", 0, reset_payload(spec))])
        session.begin(shown.world, cameras)
        session.publish(shown.message)
        return shown.wire

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

    async def act(self, session: Session, plan: Plan, payload: bytes, *, reply_to: int) -> bytes:
        """Take the action that is due; the next observation, ready to be sent.

        Args:
            session: its lock step wants this action now.
            plan: what the ego does.
            payload: canonical bytes of the plan.
            reply_to: id of the message that is answered.

        Raises:
            WorldError: the plan is refused.
            QueueFullError: too much waits for the engine; the same action may be sent again.
        """
        now = session.running_world()

        def moved() -> World:
            world = now.light_copy()
            world.step(plan)
            return world

        shown = await self._show.observe(moved, session.cameras, reply_to=reply_to)
        await self._record(session, [("action", now.steps, payload)])
        session.world = shown.world
        session.lockstep.advance(payload, shown.message, over=shown.world.over)
        session.publish(shown.message)
        return shown.wire

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
            payloads = [plan_payload(given) if given else KEPT_PLAN, *[KEPT_PLAN] * (done - 1)]
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
            world = now.light_copy()
            return world, world.apply(operations, base_revision=base_rev)

        world, outcome = await self._show.on_world_thread(edited)
        await self._record(session, [("edit", now.steps, edit_payload(operations))])
        session.world = world
        return outcome

    async def _record(self, session: Session, things: Sequence[tuple[str, int, bytes]]) -> None:
        created_us = now_us()
        entries = [
            SessionEntry(session.next_seq + k, kind, step, payload, created_us)
            for k, (kind, step, payload) in enumerate(things)
        ]
        await self._store.append_session_entries(session.session_id, entries)
        session.next_seq += len(entries)


def _beginning(session: Session, spec: ResetSpec) -> Callable[[], World]:
    start = session.start
    return lambda: World(start.scene, start.state, spec)


def _moved_on(now: World, count: int, plan: Plan | None) -> Callable[[], tuple[World, list[Event]]]:
    def move() -> tuple[World, list[Event]]:
        world = now.light_copy()
        events = world.step(plan)
        while world.steps < now.steps + count and not world.over:
            events += world.step()
        return world, events

    return move
