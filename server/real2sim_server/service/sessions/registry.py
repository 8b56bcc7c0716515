"""Which sessions there are on a worker."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from weakref import WeakKeyDictionary, WeakSet

import structlog

from real2sim_proto import ErrorCode
from real2sim_proto.drive import ResetSpec
from real2sim_proto.sessions import SessionInfo

from ...edit import ScenarioState
from ...scene import Scene
from ..idempotency import Once
from ..metrics import Metrics
from ..problems import ServiceError
from ..residency import Residency
from ..scenarios import Scenarios
from ..store import SessionRow, Store, now_us
from .describe import session_info
from .session import Session, Start
from .show import Show
from .step import Stepper

RETRY_AFTER_S = 5
SWEEP_S = 5.0

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class SessionLimits:
    """What the sessions of a worker may take.

    Attributes:
        worker_id: first part of session ids.
        max_sessions: open at one time.
        idle_seconds: without use and without connection, after which a session ends.
    """

    worker_id: str
    max_sessions: int
    idle_seconds: float


class Sessions:
    """All open sessions of a worker. Belongs to the event loop.

    Args:
        limits: how many, and for how long.
        show: draws what sessions look like.
        store: where they and their logs are written before they take effect.
        residency: keeps their scenes in memory.
        scenarios: what they may begin from.
        metrics: gets their number.
    """

    def __init__(
        self,
        limits: SessionLimits,
        *,
        show: Show,
        store: Store,
        residency: Residency,
        scenarios: Scenarios,
        metrics: Metrics,
    ) -> None:
        self.show = show
        self.stepper = Stepper(show, store)
        self.draining = False
        self._limits = limits
        self._store = store
        self._residency = residency
        self._scenarios = scenarios
        self._open: dict[str, Session] = {}
        self._in_creation = 0
        self._farewells: set[asyncio.Future[None]] = set()
        # Objects of a bare scene are the same for all sessions on it.
        self._bare_states: WeakKeyDictionary[Scene, ScenarioState] = WeakKeyDictionary()
        self._warm: WeakSet[Scene] = WeakSet()
        metrics.watch(metrics.sessions, lambda: len(self._open))

    def __iter__(self) -> Iterator[Session]:
        return iter(list(self._open.values()))

    def __len__(self) -> int:
        return len(self._open)

    @property
    def full(self) -> bool:
        """Whether another session would be refused."""
        return len(self._open) + self._in_creation >= self._limits.max_sessions

    @asynccontextmanager
    async def running(self) -> AsyncIterator[Sessions]:
        """Idle sessions are ended for the length of the block; open ones end with it."""
        sweeping = asyncio.create_task(self._sweep(), name="idle-sessions")
        try:
            yield self
        finally:
            self.draining = True
            sweeping.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await sweeping
            self.show.close()

    # --- life -------------------------------------------------------------------------------

    async def create(
        self,
        *,
        scene: str | None,
        scenario: str | None,
        spec: ResetSpec | None,
        once: Once,
        ws_base: str,
    ) -> SessionInfo:
        """A new session on a scene or a scenario.

        Args:
            scene, scenario: exactly one of them.
            spec: of the episode that begins at once; None waits for a reset.
            once: what the answer is stored under.
            ws_base: how clients reach this worker, for example ``ws://127.0.0.1:8600``.

        Raises:
            ServiceError: OVER_CAPACITY or DRAINING; INVALID_REQUEST; as residency and scenarios
                do.
            WorldError: the episode cannot run as asked.
        """
        if (scene is None) == (scenario is None):
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"a session runs on one world; scene={scene!r} and scenario={scenario!r} were "
                "given",
                hint="name exactly one: POST /v1/sessions?scene=... or ?scenario=...",
            )
        with self._place():
            row, start = await self._start(scene, scenario)
            try:
                session = Session(row, start)
                if spec is not None:
                    await self.stepper.begin(session, spec)
                info = session_info(session, ws_base=ws_base, token=row.token)
                reply = once.reply(info, status=201, headers=created_headers(info))
                await self._store.create_session(row, reply=reply)
                await self.stepper.record_beginning(session)
            except BaseException:
                self._residency.unpin(row.scene)
                raise
            self._open[session.session_id] = session
        log.info("session created", session_id=session.session_id, scene=row.scene)
        return info

    async def find(self, session_id: str) -> Session:
        """The open session of that id.

        Raises:
            ServiceError: SESSION_CLOSED when it is over, else UNKNOWN_SESSION.
        """
        if (session := self._open.get(session_id)) is not None:
            return session
        row = await self._store.session(session_id)
        if row is not None and row.closed_us is not None:
            raise _closed(session_id, row.reason or "closed")
        detail, hint = f"no session {session_id!r}", "GET /v1/sessions lists them"
        if row is not None:
            detail = f"session {session_id!r} belongs to an earlier run of this worker"
            hint = "make a new one: POST /v1/sessions"
        raise ServiceError(ErrorCode.UNKNOWN_SESSION, detail, hint=hint)

    async def close(self, session: Session, *, reason: str) -> None:
        """End a session once its step under way is done; a second time changes nothing."""
        if self._open.pop(session.session_id, None) is None:
            return
        session.closed = _closed(session.session_id, reason)
        async with session.lock:
            self._residency.unpin(session.row.scene)
            await self._store.close_session(session.session_id, reason=reason)
        for hangup in session.hangups:
            # Nobody waits for clients that are slow to listen.
            farewell = asyncio.ensure_future(hangup(session.closed))
            self._farewells.add(farewell)
            farewell.add_done_callback(self._farewells.discard)
        log.info("session closed", session_id=session.session_id, reason=reason)

    async def warm_up(self, session: Session) -> None:
        """Draw the session's scene once, so that no observation waits for a first render."""
        scene = session.start.scene
        if scene not in self._warm:
            await self.show.first_render(scene, session.start.state)
            self._warm.add(scene)

    # --- inside -----------------------------------------------------------------------------

    @contextlib.contextmanager
    def _place(self) -> Iterator[None]:
        """Holds a place for a session in creation."""
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
        self._in_creation += 1
        try:
            yield
        finally:
            self._in_creation -= 1

    async def _start(self, scene: str | None, scenario: str | None) -> tuple[SessionRow, Start]:
        """What the new session is and begins from; its scene is pinned."""
        view = await self._scenarios.view(scenario) if scenario is not None else None
        name = view.row.scene if view is not None else str(scene)
        pinned = await self._residency.pin(name)
        try:
            summary = await self._residency.summary(name)
            state = view.state if view is not None else await self._bare_state(pinned)
        except BaseException:
            self._residency.unpin(name)
            raise
        row = SessionRow(
            session_id=f"{self._limits.worker_id}.{secrets.token_hex(8)}",
            worker_id=self._limits.worker_id,
            scene=name,
            scene_hash=summary.content_hash,
            scenario_id=scenario,
            scenario_revision=view.revision if view is not None else None,
            token=secrets.token_urlsafe(24),
            created_us=now_us(),
        )
        return row, Start(pinned, summary, state)

    async def _bare_state(self, scene: Scene) -> ScenarioState:
        state = self._bare_states.get(scene)
        if state is None:
            state = self._bare_states[scene] = await asyncio.to_thread(ScenarioState.of, scene)
        return state

    async def _sweep(self) -> None:
        idle = self._limits.idle_seconds
        while True:
            await asyncio.sleep(min(SWEEP_S, idle / 2))
            for session in self:
                unused = time.monotonic() - session.used_at
                if unused > idle and not session.connected and not session.lock.locked():
                    await self.close(session, reason=f"unused for {unused:.0f} s")


def created_headers(info: SessionInfo) -> dict[str, str]:
    """Headers of the answer to a creation."""
    return {"Location": f"/v1/sessions/{info.session_id}"}


def _closed(session_id: str, reason: str) -> ServiceError:
    return ServiceError(
        ErrorCode.SESSION_CLOSED,
        f"session {session_id!r} is over: {reason}",
        hint="make a new one: POST /v1/sessions",
    )
