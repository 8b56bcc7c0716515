"""One closed-loop session: what differs from the scene, and who is connected."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from real2sim_proto import ErrorCode
from real2sim_proto.episode import ResetSpec

from ...edit import ScenarioState
from ...scene import Camera, Scene
from ...scene.io import SceneSummary
from ...world import Event, Motion, Plan, World
from .. import clock
from ..http.auth import secrets_equal
from ..http.problems import ServiceError
from ..storage.store import SessionRow
from ..storage.tokens import token_hash
from .clock_hold import ClockHold
from .lockstep import LockStep, not_reset
from .observers import ObserverQueue
from .wire import EncodedMessage

CloseWithError = Callable[[ServiceError], Awaitable[None]]
"""Tells a connection that its session is over, and ends it."""


TellController = Callable[[EncodedMessage], Awaitable[None]]


class NewestPlan(NamedTuple):
    """What a controller wants.

    Attributes:
        plan: as it was sent.
        motion: of the observation that it answers.
        took_us: from the observation to the action [us].
    """

    plan: Plan
    motion: Motion
    took_us: int


@dataclass(frozen=True, eq=False)
class EpisodeStart:
    """What a session begins from, at its creation and at every reset.

    Attributes:
        scene: pinned in memory, shared with other sessions.
        summary: of its bundle.
        state: objects of the scenario as it was then, or of the bare scene.
    """

    scene: Scene
    summary: SceneSummary
    state: ScenarioState


@dataclass(eq=False)
class Session:
    """A light view onto a scene. Belongs to the event loop; its worlds are computed elsewhere.

    Attributes:
        row: as it is in the store.
        start: scene and objects at step 0.
        resume_token: lets a controller come back; the same in every run of the worker.
        lock: held during any change of the session.
        world: the committed instant; never changed in place, so readers need no lock.
        cameras: of the episode's sensors at the sizes they name, by name.
        lockstep: which action is due.
        events: since the last answer to a REST step.
        next_seq: of the session's log.
        log_unsure: whether there may be something in the log from ``next_seq`` on that never took
            effect: the store did not say how it ended.
        unsure_replies: keys of answers that may be stored likewise.
        snapshots: instants to return to, by name.
        newest: observation of the present instant, where it has been shown.
        late: whether the planner has missed the deadline of the due action, and the clock waits.
        expires_at: monotonic time at which the episode is cut off [s]; None for never.
        controller: the connection that drives, if there is one.
        tell_controller: sends it an observation that no action has led to.
        hold: whether the clock may move.
        newest_plan: that the controller has sent.
        observers: queues of the connections that look on.
        close_callbacks: one for each open connection.
        closed: why the session is over; None while it is not.
    """

    row: SessionRow
    start: EpisodeStart
    resume_token: str
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    world: World | None = None
    cameras: dict[str, Camera] = field(default_factory=dict)
    lockstep: LockStep[EncodedMessage] = field(default_factory=LockStep)
    events: list[Event] = field(default_factory=list)
    next_seq: int = 0
    log_unsure: bool = False
    unsure_replies: tuple[str, ...] = ()
    snapshots: dict[str, World] = field(default_factory=dict)
    newest: EncodedMessage | None = None
    late: bool = False
    expires_at: float | None = None
    controller: object | None = None
    tell_controller: TellController | None = None
    hold: ClockHold = field(default_factory=ClockHold)
    newest_plan: NewestPlan | None = None
    observers: set[ObserverQueue] = field(default_factory=set)
    close_callbacks: set[CloseWithError] = field(default_factory=set)
    closed: ServiceError | None = None
    used_at: float = field(default_factory=lambda: clock.monotonic())  # noqa: PLW0108

    @property
    def session_id(self) -> str:
        """Names its worker: ``<worker>.<random>``."""
        return self.row.session_id

    @property
    def connected(self) -> bool:
        """Whether anybody is connected by socket."""
        return bool(self.close_callbacks)

    def touch(self) -> None:
        """Somebody uses the session."""
        self.used_at = clock.monotonic()

    def running_world(self) -> World:
        """The committed instant. Raises ServiceError: NOT_RESET before the first reset."""
        if self.world is None:
            raise not_reset()
        return self.world

    @property
    def spec(self) -> ResetSpec:
        """Of the running episode; the defaults before the first one."""
        return self.world.spec if self.world else ResetSpec()

    def begin(self, world: World, cameras: dict[str, Camera]) -> None:
        """An episode begins."""
        self.world, self.cameras = world, cameras
        self.lockstep.reset()
        self.events, self.newest, self.late, self.newest_plan = [], None, False, None
        cap = world.spec.wall_clock_s
        self.expires_at = None if cap is None else clock.monotonic() + cap

    @property
    def expired(self) -> bool:
        """Whether the episode has used up its wall-clock time."""
        return self.expires_at is not None and clock.monotonic() >= self.expires_at

    def take_events(self) -> list[Event]:
        """Events since this was called last."""
        taken, self.events = self.events, []
        return taken

    def check_open(self) -> None:
        """Raises ServiceError: SESSION_CLOSED once the session is over."""
        if self.closed is not None:
            raise self.closed

    def check_no_controller(self) -> None:
        """Raises ServiceError: CONTROLLER_TAKEN while a controller is connected."""
        if self.controller is not None:
            raise controller_taken(self.session_id)

    def publish(self, message: EncodedMessage) -> None:
        """The newest observation, for all observers; never waits."""
        self.newest = message
        for queue in self.observers:
            queue.put(message)


def opens_session(token: str | None, row: SessionRow) -> bool:
    """Whether a token is that of the session of a row."""
    return token is not None and secrets_equal(token_hash(token), row.token_hash)


def controller_taken(session_id: str) -> ServiceError:
    """CONTROLLER_TAKEN."""
    return ServiceError(
        ErrorCode.CONTROLLER_TAKEN,
        f"session {session_id!r} has a controller on its drive socket",
        hint="connect as an observer, or make a session of your own",
    )
