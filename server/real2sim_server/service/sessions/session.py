"""One closed-loop session: its lockstep, clock, edits, observers and REST models."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any, Generic, NamedTuple, TypeVar

from real2sim_proto import DRIVE_SUBPROTOCOL, ErrorCode
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES
from real2sim_proto.episode import MAX_SENSORS, ResetSpec
from real2sim_proto.scenarios import MAX_OPERATIONS_PER_REQUEST
from real2sim_proto.sessions import SessionEdited, SessionInfo, SessionState

from ...edit import EditOutcome, ScenarioState
from ...scene import Camera, Scene
from ...scene.io import SceneSummary
from ...world import (
    Event,
    LoggedPath,
    Motion,
    Plan,
    Score,
    World,
    agent_fields,
    ego_fields,
    metrics_version,
    plan_in_world,
)
from ...world.path import whole_route
from ...world.plan import PlannedTrajectory
from .. import clock
from ..accounts import token_hash
from ..http.auth import secrets_equal
from ..http.responses import ServiceError
from ..library.views import camera_infos, edited_objects
from ..storage.store import SessionRow
from .sensors import MAX_IMAGE_BYTES
from .wire import EncodedMessage

A = TypeVar("A")


class LockStep(Generic[A]):
    """The due action, and the answer to the last one.

    Call :meth:`cached_answer` before the world advances and :meth:`advance` afterwards. An action
    that is refused in between changes nothing. Actions are compared by their canonical bytes.

    Attributes:
        step: step of the newest observation; None before the first reset.
        over: whether the episode has ended.
    """

    def __init__(self) -> None:
        self.step: int | None = None
        self.over = False
        self._last: tuple[bytes, A] | None = None

    def reset(self, step: int = 0, *, over: bool = False) -> None:
        """Start an episode at step 0, or return to a snapshot at another step."""
        self.step, self.over, self._last = step, over, None

    def end(self) -> None:
        """End the episode without a step; the last answer can still be repeated."""
        self.over = True

    def restore_answer(self, content: bytes, answer: A) -> None:
        """Restore the answer to the last step after a replay."""
        self._last = (content, answer)

    def cached_answer(self, step: int, content: bytes) -> A | None:
        """The answer already given to this action; None if it is the due action.

        Args:
            step: step of the observation that the action answers.
            content: canonical bytes of the action.

        Raises:
            ServiceError: NOT_RESET; STEP_CONFLICT if the step had another action;
                STALE_STEP for older steps; BAD_STEP for newer steps; EPISODE_OVER.
        """
        if self.step is None:
            raise not_reset()
        if step == self.step - 1 and self._last is not None:
            return _repeated(step, content, *self._last)
        if step < self.step:
            raise ServiceError(
                ErrorCode.STALE_STEP,
                f"an action for step {step}; the session is at step {self.step}",
                hint="answer the newest observation",
            )
        if self.over:
            raise ServiceError(
                ErrorCode.EPISODE_OVER,
                f"the episode ended at step {self.step}",
                hint="reset the session to start another",
            )
        if step > self.step:
            raise ServiceError(
                ErrorCode.BAD_STEP,
                f"an action for step {step}, which is in the future; the session is at "
                f"step {self.step}",
                hint="send the step of the newest observation",
            )
        return None

    def is_due(self, step: int) -> bool:
        """Whether an action for ``step`` is due."""
        return step == self.step and not self.over

    def advance(self, content: bytes, answer: A, *, over: bool) -> None:
        """Take the due action, and store ``answer`` until the next one."""
        self._move(1, over=over)
        self._last = (content, answer)

    def skip(self, steps: int, *, over: bool) -> None:
        """Advance without an action; no answer is stored."""
        self._move(steps, over=over)
        self._last = None

    def _move(self, steps: int, *, over: bool) -> None:
        if self.step is None:
            raise not_reset()
        self.step += steps
        self.over = over


def not_reset() -> ServiceError:
    """A NOT_RESET error."""
    return ServiceError(
        ErrorCode.NOT_RESET,
        "no episode has begun in this session",
        hint="send reset first; by REST: POST /v1/sessions/{id}/reset",
    )


def _repeated(step: int, content: bytes, taken: bytes, answer: A) -> A:
    if content == taken:
        return answer
    raise ServiceError(
        ErrorCode.STEP_CONFLICT,
        f"step {step} has been answered with another action, which has taken effect",
        hint=f"repeat that action to get its observation again, or act on step {step + 1}",
    )


class ClockHold:
    """Gates actions: lets all or a number of them pass, immediately or at a pace.

    Other actions wait. For use on the event loop.
    """

    def __init__(self) -> None:
        self._steps: int | None = None
        self._pace: float | None = None
        self._next_s = 0.0
        self._changed = asyncio.Event()

    @property
    def held(self) -> bool:
        """Whether the next action has to wait for a release."""
        return self._steps == 0

    @property
    def free(self) -> bool:
        """Whether actions pass without waiting."""
        return self._steps is None and self._pace is None

    @property
    def wait_s(self) -> float:
        """Remaining time until the next action may pass [s]."""
        if self.held:
            return math.inf
        return 0.0 if self._pace is None else max(0.0, self._next_s - clock.monotonic())

    def release(self, *, pace: float | None = None) -> None:
        """Let all actions pass; ``pace`` is in simulated seconds per second."""
        self._steps, self._pace = None, pace
        self._changed.set()

    def hold(self, *, after: int = 0) -> None:
        """Let ``after`` more actions pass, then hold."""
        self._steps = after
        self._changed.set()

    def take_step(self, dt_us: int) -> None:
        """Count a passing action with the given step duration."""
        if self._steps:
            self._steps -= 1
        if self._pace is not None:
            now = clock.monotonic()
            self._next_s = max(self._next_s, now) + dt_us * 1e-6 / self._pace

    async def wait(self, seconds: float) -> None:
        """Wait for a change, with a timeout."""
        self._changed.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._changed.wait()


KEPT = 4
"""Maximum queue length for a slow observer; older observations are dropped."""


class ObserverQueue:
    """A short queue of observations for one observer; adding one never waits.

    Attributes:
        dropped: number of observations dropped for a slow observer.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: deque[EncodedMessage] = deque(maxlen=KEPT)
        self._filled = asyncio.Event()

    def put(self, message: EncodedMessage) -> None:
        """Add the newest observation; a full queue drops the oldest."""
        if len(self._waiting) == KEPT:
            self.dropped += 1
        self._waiting.append(message)
        self._filled.set()

    async def take(self) -> EncodedMessage:
        """The oldest queued observation."""
        await self._filled.wait()
        message = self._waiting.popleft()
        if not self._waiting:
            self._filled.clear()
        return message


CloseWithError = Callable[[ServiceError], Awaitable[None]]
"""Ends a connection and sends the reason."""


TellController = Callable[[EncodedMessage], Awaitable[None]]


class NewestPlan(NamedTuple):
    """The newest plan of a controller.

    Attributes:
        plan: as sent.
        motion: motion in the observation that it answers.
        took_us: wall-clock time from the observation to the action [us].
    """

    plan: Plan
    motion: Motion
    took_us: int


@dataclass(frozen=True, eq=False)
class EpisodeStart:
    """Start of a session, at its creation and at every reset.

    Attributes:
        scene: pinned in memory, shared with other sessions.
        summary: summary of its bundle.
        state: objects of the scenario at that time, or of the bare scene.
    """

    scene: Scene
    summary: SceneSummary
    state: ScenarioState


@dataclass(eq=False)
class Session:
    """A session on a scene, for use on the event loop; its worlds are computed elsewhere.

    Attributes:
        row: its row in the store.
        start: scene and objects at step 0.
        resume_token: token to reconnect a controller; the same in every run of the worker.
        lock: held during any change of the session.
        world: the committed world; never modified in place, so readers need no lock.
        cameras: cameras of the episode's sensors at the requested sizes, by name.
        lockstep: the due action.
        events: events since the last answer to a REST step.
        next_seq: next entry of the session's log.
        log_unsure: whether the log may have entries from ``next_seq`` that never took effect,
            because the store did not report the outcome.
        unsure_replies: keys of replies that may be stored although they never took effect.
        snapshots: saved states by name.
        newest: observation of the current step, if it has been computed.
        late: whether the planner has missed the deadline of the due action while the clock waits.
        expires_at: monotonic time at which the episode is ended [s]; None for no limit.
        controller: the connection that drives, if any.
        tell_controller: sends the controller an observation that answers no action.
        hold: gates the clock.
        newest_plan: newest plan of the controller.
        observers: queues of the observers' connections.
        close_callbacks: one for each open connection.
        closed: reason for the end of the session; None while it is open.
    """

    row: SessionRow
    start: EpisodeStart
    resume_token: str = field(repr=False)
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
        """Session id, which starts with its worker: ``<worker>.<random>``."""
        return self.row.session_id

    @property
    def connected(self) -> bool:
        """Whether any socket is connected."""
        return bool(self.close_callbacks)

    def touch(self) -> None:
        """Record a use of the session."""
        self.used_at = clock.monotonic()

    def running_world(self) -> World:
        """The committed world. Raises ServiceError: NOT_RESET before the first reset."""
        if self.world is None:
            raise not_reset()
        return self.world

    @property
    def spec(self) -> ResetSpec:
        """Spec of the current episode; the defaults before the first one."""
        return self.world.spec if self.world else ResetSpec()

    def begin(self, world: World, cameras: dict[str, Camera]) -> None:
        """Begin an episode."""
        self.world, self.cameras = world, cameras
        self.lockstep.reset()
        self.events, self.newest, self.late, self.newest_plan = [], None, False, None
        cap = world.spec.wall_clock_s
        self.expires_at = None if cap is None else clock.monotonic() + cap

    @property
    def expired(self) -> bool:
        """Whether the episode has exceeded its wall-clock time."""
        return self.expires_at is not None and clock.monotonic() >= self.expires_at

    def take_events(self) -> list[Event]:
        """Events since the last call."""
        taken, self.events = self.events, []
        return taken

    def check_open(self) -> None:
        """Raises ServiceError: SESSION_CLOSED if the session has ended."""
        if self.closed is not None:
            raise self.closed

    def check_no_controller(self) -> None:
        """Raises ServiceError: CONTROLLER_TAKEN while a controller is connected."""
        if self.controller is not None:
            raise controller_taken(self.session_id)

    def publish(self, message: EncodedMessage) -> None:
        """Send the newest observation to all observers; never waits."""
        self.newest = message
        for queue in self.observers:
            queue.put(message)


def opens_session(token: str | None, row: SessionRow) -> bool:
    """Whether a token is the session token of a row."""
    return token is not None and secrets_equal(token_hash(token), row.token_hash)


def controller_taken(session_id: str) -> ServiceError:
    """A CONTROLLER_TAKEN error."""
    return ServiceError(
        ErrorCode.CONTROLLER_TAKEN,
        f"session {session_id!r} has a controller on its drive socket",
        hint="connect as an observer, or make a session of your own",
    )


# REST models of sessions.


def session_info(session: Session, *, ws_base: str, token: str = "") -> SessionInfo:
    """A session; only the reply to its creation has the token."""
    world, row = session.world, session.row
    created = datetime.fromtimestamp(row.created_us / 1e6, UTC)
    return SessionInfo(
        session_id=row.session_id,
        scene=row.scene,
        scenario_id=row.scenario_id,
        ws_url=f"{ws_base}/v1/sessions/{row.session_id}/drive",
        token=token,
        owner=row.owner,
        created_at=created.isoformat(timespec="milliseconds"),
        step=world.steps if world else None,
        t_us=world.t_us if world else None,
        controller=session.controller is not None,
        held=session.hold.held,
        reset=session.spec,
    )


def session_state(session_id: str, world: World, events: Iterable[Event]) -> SessionState:
    """Poses of all objects at a step, and the events before it."""
    seen = world.observe()
    return SessionState.model_validate(
        {
            "session_id": session_id,
            "step": world.steps,
            "t_us": world.t_us,
            "revision": world.revision,
            "ego": ego_fields(world.motion, world.T_world_vehicle, world.scene.ego_size),
            "agents": agent_fields(world.agents, world.lamps),
            "events": [event.fields() for event in events],
            "metrics": seen.metrics,
            "terminated": world.terminated,
            "truncated": world.truncated,
            "reason": world.reason,
            "lap": world.lap,
            "drawn": world.sampled,
        }
    )


def shown_state(session: Session) -> SessionState:
    """Like :func:`session_state`, with the newest plan, for observers."""
    state = session_state(session.session_id, session.running_world(), tuple(session.events))
    newest = session.newest_plan
    plan = plan_in_world(newest.plan, newest.motion) if newest is not None else None
    return state.model_copy(
        update={
            "held": session.hold.held,
            "plan": [tuple(pose) for pose in plan.poses.tolist()]
            if isinstance(plan, PlannedTrajectory)
            else [],
            "planning_ms": newest.took_us / 1e3 if newest is not None and newest.took_us else None,
        }
    )


def session_edited(session_id: str, world: World, outcome: EditOutcome) -> SessionEdited:
    """The result of an edit in a running session."""
    return SessionEdited(
        session_id=session_id,
        step=world.steps,
        revision=world.revision,
        created=list(outcome.created),
        warnings=list(outcome.warnings),
    )


def welcome_fields(session: Session, role: str) -> dict[str, Any]:
    """Members of the protocol's Welcome, without envelope."""
    start, world = session.start, session.world
    objects = (world.state if world else start.state).visible
    infos = edited_objects(objects, start.summary, tracks=False)
    return {
        "protocol": DRIVE_SUBPROTOCOL,
        "session_id": session.session_id,
        "role": role,
        "versions": {
            "server": version("real2sim"),
            "scene_hash": session.row.scene_hash,
            "metrics": metrics_version(),
        },
        "limits": {
            "max_message_bytes": MAX_CLIENT_MESSAGE_BYTES,
            "max_operations_per_request": MAX_OPERATIONS_PER_REQUEST,
            "max_cameras_per_step": MAX_SENSORS,
            "max_image_bytes": MAX_IMAGE_BYTES,
        },
        "cameras": [c.model_dump(mode="json") for c in camera_infos(tuple(start.scene.rig))],
        "objects": [o.model_dump(mode="json", exclude_none=True) for o in infos],
        "route": whole_route(LoggedPath(start.scene.ego)),
        "start_us": start.scene.start_us,
        "end_us": start.scene.end_us,
        "step": world.steps if world else None,
        "revision": world.revision if world else 0,
        "resume_token": session.resume_token if role == "controller" else None,
    }


def result_fields(world: World | None, scores: Sequence[Score]) -> dict[str, Any]:
    """Members of the protocol's Result, without envelope; ``world`` is the last world, if any."""
    return {
        "steps": world.steps if world else 0,
        "t_us": world.t_us if world else None,
        "reason": world.reason if world else None,
        "metrics": world.metrics() if world else {},
        "scores": [score.fields() for score in scores],
    }
