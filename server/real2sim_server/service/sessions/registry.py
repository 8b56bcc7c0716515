"""The sessions of a worker, and their recovery after a restart."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import re
import secrets
from collections import Counter
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary, WeakSet

import structlog

from real2sim_proto import ErrorCode, decode
from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import PLAN
from real2sim_proto.sessions import SessionInfo

from ...edit import LogEntry, Scenario, ScenarioState
from ...scene import Camera, Scene
from ...world import Score, World
from ...world.replay import Entry, Replayer, last_episode, no_action_impact, plan_payload
from ...world.scoring import scores_of
from .. import clock
from ..accounts import Accounts, owner_name, token_hash
from ..http.requests import IdempotentRequest
from ..http.responses import ServiceError
from ..http.telemetry import Metrics
from ..library.scenes import SceneCache
from ..scenarios import Scenarios
from ..storage.fleet import Leases
from ..storage.store import SessionEntry, SessionRow, Store
from ..warm_up import KernelWarmUp
from .pipeline import Step, StepPipeline
from .session import EpisodeStart, Session, session_info
from .shared_memory import Segments
from .step import Stepper

# Recovery: rebuild sessions of an earlier run of the worker from their logs.


def entries_of(rows: Iterable[SessionEntry]) -> list[Entry]:
    """Entries of a stored log, to replay in a world."""
    return [Entry(row.kind, row.step or 0, row.payload) for row in rows]


async def rebuild(session: Session, *, store: Store, pipeline: StepPipeline) -> None:
    """Rebuild a session to its state after its last entry.

    All entries are replayed without rendering, except the last step. Its client may not have
    received the observation, so it is rendered for a repeated action.

    Args:
        session: at its start, with its scene pinned.
        store: has its log.
        pipeline: advances and renders worlds.
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
    """Cameras of an episode, once everything that its observations would wait for is ready."""
    start, sensors = session.start, world.spec.sensors
    cameras = pipeline.cameras(start.scene, sensors)
    await pipeline.ranging_ready(world.ranging, sensors, cameras)
    await pipeline.levels_ready(start.scene, start.state, sensors, cameras)
    return cameras


async def state_at(scenarios: Scenarios, scenario_id: str, revision: int) -> ScenarioState:
    """Objects of a scenario at a revision.

    Raises:
        ServiceError: UNKNOWN_SCENARIO if it was deleted.
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
    """Raises ServiceError: SCENE_BROKEN if the scene differs from the session's."""
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
    """The bytes that identify an action: its plan, encoded by this version.

    The version that wrote the entry may have encoded fewer members.
    """
    fields = decode(entry.payload)["plan"]
    return plan_payload(None if fields is None else PLAN.validate_python(fields))


RETRY_AFTER_S = 5
TOKEN_BYTES = 24
IDLE_CHECK_S = 5.0

_ID = re.compile(r"[A-Za-z0-9_.\-]{1,80}")

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class SessionLimits:
    """Limits of a worker's sessions.

    Attributes:
        worker_id: first part of session ids.
        max_sessions: maximum number of open sessions.
        idle_seconds: time without use or connection after which a session is evicted from memory;
            a later request rebuilds it from its log.
    """

    worker_id: str
    max_sessions: int
    idle_seconds: float


class Sessions:
    """All open sessions of a worker, for use on the event loop.

    Args:
        limits: maximum number and idle time of sessions.
        pipeline: renders sessions.
        kernels: kernels that episodes wait for.
        store: stores sessions and their logs before they take effect.
        scene_cache: holds their scenes in memory.
        scenarios: scenarios to start from.
        metrics: receives the number of sessions.
        segments: shared memory for controllers on this machine.
        leases: sessions of each worker with the same store.
        accounts: accounts of the owners, with their limits.

    Attributes:
        resume_key: key of the controllers' resume tokens.
    """

    def __init__(
        self,
        limits: SessionLimits,
        *,
        pipeline: StepPipeline,
        kernels: KernelWarmUp,
        store: Store,
        scene_cache: SceneCache,
        scenarios: Scenarios,
        metrics: Metrics,
        segments: Segments,
        leases: Leases,
        accounts: Accounts | None = None,
    ) -> None:
        self.pipeline = pipeline
        self.segments = segments
        self.stepper = Stepper(pipeline, kernels, store, on_fenced=self.drop)
        self.metrics = metrics
        self.draining = self._handed_over = False
        self.resume_key = secrets.token_bytes()
        self._limits = limits
        self._store = store
        self._leases = leases
        self._scene_cache = scene_cache
        self._scenarios = scenarios
        self._open: dict[str, Session] = {}
        self._accounts = accounts or Accounts(token=None, file=None)
        self._in_creation: Counter[str] = Counter()
        self._rebuilding: dict[str, asyncio.Task[Session]] = {}
        self._closing: set[asyncio.Future[None]] = set()
        # All sessions on a bare scene share its objects.
        self._unedited_states: WeakKeyDictionary[Scene, ScenarioState] = WeakKeyDictionary()
        self._warm: WeakSet[Scene] = WeakSet()
        metrics.watch(metrics.sessions, lambda: len(self._open))

    def __iter__(self) -> Iterator[Session]:
        return iter(list(self._open.values()))

    def __len__(self) -> int:
        return len(self._open)

    @property
    def full(self) -> bool:
        """Whether another session would be refused."""
        return len(self._open) + self._in_creation.total() >= self._limits.max_sessions

    def owned(self) -> Counter[str]:
        """Number of sessions by the name of the owner's token, including those being created."""
        return self._in_creation + Counter(s.row.owner for s in self._open.values())

    @asynccontextmanager
    async def running(self) -> AsyncIterator[Sessions]:
        """Run the step pipeline and evict idle sessions during the block.

        New sessions are refused after it.
        """
        self.pipeline.start()
        evicting = asyncio.create_task(self._evict_idle(), name="idle-sessions")
        try:
            yield self
        finally:
            self.draining = True
            evicting.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await evicting
            self.pipeline.close()

    # --- lifecycle --------------------------------------------------------------------------

    async def create(
        self,
        *,
        scene: str | None,
        scenario: str | None,
        spec: ResetSpec | None,
        idempotent: IdempotentRequest,
        ws_base: str,
    ) -> SessionInfo:
        """Create a session on a scene or a scenario.

        Args:
            scene, scenario: exactly one of them.
            spec: starts an episode immediately; None waits for a reset.
            idempotent: stores the reply.
            ws_base: address of this worker for clients, for example ``ws://127.0.0.1:8600``.

        Raises:
            ServiceError: OVER_CAPACITY, DRAINING, INVALID_REQUEST, or an error of the scene cache
                or the scenarios.
            WorldError: the episode cannot run with these options.
        """
        if (scene is None) == (scenario is None):
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"a session runs on one world; scene={scene!r} and scenario={scenario!r} were "
                "given",
                hint="name exactly one: POST /v1/sessions?scene=... or ?scenario=...",
            )
        with self._reserved_slot(owner_name()):
            token = secrets.token_urlsafe(TOKEN_BYTES)
            row, start = await self._start(scene, scenario, token)
            try:
                session = self._session(row, start)
                if spec is not None:
                    await self.stepper.begin(session, spec)
                info = session_info(session, ws_base=ws_base, token=token)
                reply = idempotent.reply(info, status=201, headers=created_headers(info))
                entries = self.stepper.beginning_entries(session)
                await self._store.create_session(row, entries=entries, reply=reply)
                session.next_seq = len(entries)
            except BaseException:
                self._scene_cache.unpin(row.scene)
                raise
            self._open[session.session_id] = session
        log.info("session created", session_id=session.session_id, scene=row.scene)
        return info

    async def find(self, session_id: str) -> Session:
        """The open session with this id.

        Sessions of an earlier run or of a dead worker are rebuilt first.

        Raises:
            ServiceError: SESSION_CLOSED if it has ended, UNKNOWN_SESSION, SESSION_ELSEWHERE while
                another worker owns it, or an error of the rebuild.
        """
        if (session := self._open.get(session_id)) is not None:
            if session.log_unsure:
                async with session.lock:
                    await self.stepper.settle(session)
            return session
        return await self._rebuilt(check_not_closed(await self.row(session_id)))

    async def row(self, session_id: str) -> SessionRow:
        """The row of a session, open or closed, of any worker, without rebuilding it.

        Raises:
            ServiceError: UNKNOWN_SESSION.
        """
        if (session := self._open.get(session_id)) is not None:
            return session.row
        # Do not query ids of another format, because the database may reject them.
        row = await self._store.session(session_id) if _ID.fullmatch(session_id) else None
        if row is None:
            hint = "GET /v1/sessions lists them"
            raise ServiceError(ErrorCode.UNKNOWN_SESSION, f"no session {session_id!r}", hint=hint)
        return row

    async def fork(
        self,
        session: Session,
        *,
        ws_base: str,
        idempotent: IdempotentRequest,
        step: int | None = None,
    ) -> SessionInfo:
        """Create a session that continues from a step of another, whose lock is held.

        Its log begins with a copy of the other's, so that it can be rebuilt independently.

        Args:
            session: the other session.
            ws_base: address of this worker for clients.
            idempotent: stores the reply.
            step: step of the current episode; None for the newest.

        Raises:
            ServiceError: OVER_CAPACITY, DRAINING or NOT_RESET; INVALID_REQUEST for a step outside
                the episode.
        """
        world = session.running_world()
        with self._reserved_slot(owner_name()):
            token = secrets.token_urlsafe(TOKEN_BYTES)
            row = replace(
                session.row,
                session_id=f"{self._limits.worker_id}.{secrets.token_hex(8)}",
                token_hash=token_hash(token),
                created_us=clock.now_us(),
                owner=owner_name(),
            )
            await self._scene_cache.pin(row.scene)
            try:
                rows = await self._store.session_entries(session.session_id)
                entries = [entry for entry in rows if entry.seq < session.next_seq]
                if step is not None:
                    world, entries = await self._back_at(session, entries, step)
                forked = self._session(row, session.start)
                forked.begin(world, session.cameras)
                forked.lockstep.reset(world.steps, over=world.over)
                forked.next_seq = len(entries)
                forked.snapshots = dict(session.snapshots) if step is None else {}
                info = session_info(forked, ws_base=ws_base, token=token)
                reply = idempotent.reply(info, status=201, headers=created_headers(info))
                await self._store.create_session(row, entries=entries, reply=reply)
            except BaseException:
                self._scene_cache.unpin(row.scene)
                raise
            self._open[row.session_id] = forked
        log.info("session forked", session_id=row.session_id, parent=session.session_id)
        return info

    async def _back_at(
        self, session: Session, rows: list[SessionEntry], step: int
    ) -> tuple[World, list[SessionEntry]]:
        """The world at a step, and the log up to it.

        Raises:
            ServiceError: INVALID_REQUEST if the episode does not have the step.
        """
        episode = last_episode(entries_of(rows))

        def found() -> tuple[World, int] | None:
            replayer, last = Replayer.on(session.start.scene, session.start.state), None
            for count, entry in enumerate(episode, start=1):
                world = replayer.apply(entry)
                if world.steps == step and entry.kind != "stop":
                    last = world, count
            return last

        back = await self.pipeline.on_world_thread(found)
        if back is None:
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"step {step} is not one of the episode, which is at {session.lockstep.step}",
                hint="fork from a step between 0 and the current one",
            )
        world, count = back
        return world, rows[: len(rows) - len(episode) + count]

    async def end_episode(self, session: Session) -> None:
        """End the current episode at its newest step, and notify the controller. Idempotent."""
        async with session.lock:
            session.check_open()
            if session.running_world().over:
                return
            message = await self.stepper.stop(session, "stopped")
            # An action that waits for the clock is refused once the lock is released.
            if session.tell_controller is not None:
                with contextlib.suppress(Exception):
                    await session.tell_controller(message)
        session.hold.release()

    async def entries(self, session: Session) -> list[Entry]:
        """All entries of a session's log, oldest first."""
        # A step in progress is already in the log, but may still be withdrawn.
        end = session.next_seq
        rows = await self._store.session_entries(session.session_id)
        return entries_of(row for row in rows if row.seq < end)

    async def scores(self, session: Session) -> list[Score]:
        """Final scores of the current episode; empty before the first reset.

        After a collision, the episode is simulated again without reactions of the ego, for the
        impact speed that NeuroNCAP uses as reference.
        """
        world = session.world
        if world is None:
            return []
        entries = last_episode(await self.entries(session))

        def score() -> list[Score]:
            context = world.context
            if world.accumulator.first_impact is not None:
                replayer = Replayer.on(session.start.scene, session.start.state)
                context = replace(context, no_action_impact=no_action_impact(replayer, entries))
            return scores_of(world.accumulator, context)

        return await self.pipeline.on_world_thread(score)

    async def close(self, session: Session, *, reason: str) -> None:
        """End a session after the step in progress; idempotent."""
        if self._open.pop(session.session_id, None) is None:
            return
        session.closed = _closed(session.session_id, reason)
        async with session.lock:
            try:
                await self._store.close_session(session.row.claim, reason=reason)
            except BaseException:
                # The session has not ended until the store confirms it.
                session.closed = None
                self._open[session.session_id] = session
                raise
            self._scene_cache.unpin(session.row.scene)
        self._tell(session, session.closed)
        log.info("session closed", session_id=session.session_id, reason=reason)

    def drop(self, session: Session) -> None:
        """Drop a session that another worker has taken over or may take over. Idempotent.

        Its connections are redirected.
        """
        if self._open.get(session.session_id) is not session:
            return
        del self._open[session.session_id]
        session.closed = elsewhere(session.session_id)
        self._scene_cache.unpin(session.row.scene)
        self._tell(session, session.closed)
        log.warning("session left to another worker", session_id=session.session_id)

    def hand_over(self) -> None:
        """Hand over all sessions to other workers and accept no more. Their logs are complete."""
        self.draining = self._handed_over = True
        for session in list(self):
            self.drop(session)

    async def drop_lost(self) -> None:
        """Drop all sessions that other workers took over because they considered this one dead."""
        epochs = await self._leases.epochs(list(self._open))
        for session in self:
            if epochs.get(session.session_id) != session.row.epoch:
                self.drop(session)

    def evict(self, session: Session) -> None:
        """Free the memory of a session without connections; :meth:`find` rebuilds it."""
        if self._open.pop(session.session_id, None) is None:
            return
        # A concurrent request must not advance a world that is being rebuilt.
        session.closed = ServiceError(
            ErrorCode.QUEUE_FULL,
            f"session {session.session_id!r} has just left the memory because it was idle",
            hint="send it again: the session is rebuilt from its log",
        )
        self._scene_cache.unpin(session.row.scene)
        log.info("session evicted", session_id=session.session_id)

    async def warm_up(self, session: Session) -> None:
        """Render the session's scene once, so that no observation waits for a first render."""
        scene = session.start.scene
        if scene not in self._warm:
            await self.pipeline.first_render(scene, session.start.state)
            self._warm.add(scene)

    def resume_token(self, row: SessionRow) -> str:
        """Token to reconnect a controller. It is the same in every run and is not stored."""
        return hmac.new(self.resume_key, row.session_id.encode(), "sha256").hexdigest()

    # --- internals --------------------------------------------------------------------------

    @contextlib.contextmanager
    def _reserved_slot(self, owner: str) -> Iterator[None]:
        """Reserve a slot for a session that is being created.

        Raises:
            ServiceError: DRAINING or OVER_CAPACITY.
            OverLimitError: the owner's session limit is reached.
            RevokedError: the owner's token has been removed.
        """
        if self.draining:
            raise ServiceError(ErrorCode.DRAINING, "the worker is stopping")
        if self.full:
            raise ServiceError(
                ErrorCode.OVER_CAPACITY,
                f"all {self._limits.max_sessions} sessions of this worker are taken",
                hint="send it again after Retry-After seconds, or end a session: "
                "DELETE /v1/sessions/{id}",
                headers={"Retry-After": str(RETRY_AFTER_S)},
            )
        self._accounts.of_owner(owner).check_sessions(self.owned()[owner])
        self._in_creation[owner] += 1
        try:
            yield
        finally:
            self._in_creation[owner] -= 1

    async def _rebuilt(self, row: SessionRow) -> Session:
        """The session of a row; concurrent requests wait for the same rebuild."""
        task = self._rebuilding.get(row.session_id)
        if task is None:
            task = asyncio.create_task(self._rebuild(row))
            self._rebuilding[row.session_id] = task
            task.add_done_callback(lambda _: self._rebuilding.pop(row.session_id, None))
        return await asyncio.shield(task)

    async def _rebuild(self, row: SessionRow) -> Session:
        if self._handed_over:
            raise elsewhere(row.session_id)
        with self._reserved_slot(row.owner):
            taken = await self._leases.take_over(row.session_id)
            if taken is None:
                raise elsewhere(row.session_id)
            row = taken
            pinned = await self._scene_cache.pin(row.scene)
            try:
                summary = await self._scene_cache.summary(row.scene)
                check_scene(row, summary.content_hash)
                if row.scenario_id is not None and row.scenario_revision is not None:
                    state = await state_at(self._scenarios, row.scenario_id, row.scenario_revision)
                else:
                    state = await self._unedited_state(pinned)
                start = EpisodeStart(pinned, summary, state)
                session = self._session(row, start)
                await rebuild(session, store=self._store, pipeline=self.pipeline)
            except BaseException:
                self._scene_cache.unpin(row.scene)
                raise
            self._open[row.session_id] = session
        log.info("session rebuilt", session_id=row.session_id, entries=session.next_seq)
        return session

    def _tell(self, session: Session, error: ServiceError) -> None:
        """End a session's connections without waiting for them, because clients may read slowly."""
        for close in session.close_callbacks:
            closing = asyncio.ensure_future(close(error))
            self._closing.add(closing)
            closing.add_done_callback(self._closing.discard)

    def _session(self, row: SessionRow, start: EpisodeStart) -> Session:
        return Session(row, start, resume_token=self.resume_token(row))

    async def _start(
        self, scene: str | None, scenario: str | None, token: str
    ) -> tuple[SessionRow, EpisodeStart]:
        """Id and start of the new session; its scene is pinned."""
        view = await self._scenarios.view(scenario) if scenario is not None else None
        name = view.row.scene if view is not None else str(scene)
        pinned = await self._scene_cache.pin(name)
        try:
            summary = await self._scene_cache.summary(name)
            state = view.state if view is not None else await self._unedited_state(pinned)
        except BaseException:
            self._scene_cache.unpin(name)
            raise
        row = SessionRow(
            session_id=f"{self._limits.worker_id}.{secrets.token_hex(8)}",
            worker_id=self._limits.worker_id,
            scene=name,
            scene_hash=summary.content_hash,
            scenario_id=scenario,
            scenario_revision=view.revision if view is not None else None,
            token_hash=token_hash(token),
            created_us=clock.now_us(),
            owner=owner_name(),
        )
        return row, EpisodeStart(pinned, summary, state)

    async def _unedited_state(self, scene: Scene) -> ScenarioState:
        state = self._unedited_states.get(scene)
        if state is None:
            assets = self._scenarios.assets
            state = await asyncio.to_thread(lambda: ScenarioState.of(scene, assets=assets))
            self._unedited_states[scene] = state
        return state

    async def _evict_idle(self) -> None:
        idle = self._limits.idle_seconds
        while True:
            await clock.sleep_until(clock.monotonic() + min(IDLE_CHECK_S, idle / 2))
            for session in self:
                unused = clock.monotonic() - session.used_at
                if unused > idle and not session.connected and not session.lock.locked():
                    self.evict(session)


def created_headers(info: SessionInfo) -> dict[str, str]:
    """Headers of the reply to a creation."""
    return {"Location": f"/v1/sessions/{info.session_id}"}


def check_not_closed(row: SessionRow) -> SessionRow:
    """The row. Raises ServiceError: SESSION_CLOSED if its session has ended."""
    if row.closed_us is not None:
        raise _closed(row.session_id, row.reason or "closed")
    return row


def elsewhere(session_id: str) -> ServiceError:
    """A SESSION_ELSEWHERE error."""
    return ServiceError(
        ErrorCode.SESSION_ELSEWHERE,
        f"session {session_id!r} is another worker's",
        hint="send it again after Retry-After seconds by the address that made the session: the "
        "worker that has it answers there, or this one takes it over once that is gone",
        headers={"Retry-After": "1"},
    )


def _closed(session_id: str, reason: str) -> ServiceError:
    return ServiceError(
        ErrorCode.SESSION_CLOSED,
        f"session {session_id!r} is over: {reason}",
        hint="make a new one: POST /v1/sessions",
    )
