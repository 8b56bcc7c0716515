"""Driving a session over its socket, in lock step: one plan, one observation.

A session is used by one thread or task at a time.
"""

from __future__ import annotations

import contextlib
import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar, Unpack

import websockets
from websockets.sync.client import connect

from real2sim_proto.drive import Edited, Envelope, Forked, Kept, Result, Welcome
from real2sim_proto.operations import Operation
from real2sim_proto.plans import Plan
from real2sim_proto.sessions import SessionInfo

from . import _requests
from ._conversation import PendingRequest, ProtocolState
from ._drive_socket import check_subprotocol, handshake_errors, lost_connection, socket_options
from ._sensors import ResetOptions, Sensor, reset_spec, sensor_specs
from ._transport import Target, Transport
from .errors import (
    CapacityError,
    ConnectionLostError,
    NotOpenError,
    Real2SimError,
    ReplyTimeoutError,
    UnreachableError,
)
from .images import write_atomically
from .observation import Observation, View, observation_from_wire, view_from_frames
from .version import SDK

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection as Socket

A = TypeVar("A", bound=Envelope)

COMING_BACK = (UnreachableError, CapacityError, ReplyTimeoutError)
"""What a worker that is being started again answers with."""


def backoff(attempt: int) -> float:
    """Seconds before try number ``attempt`` of a connection that was lost; with jitter."""
    return min(0.05 * 2.0**attempt, 2.0) * (0.75 + 0.25 * random.random())


@dataclass(frozen=True)
class SessionPlan:
    """Which session to open and how.

    Attributes:
        scene, scenario: what a new session runs on; exactly one of them.
        session_id: joins this session instead of making one.
        token: of the session that is joined.
        role: ``controller`` or ``observer``.
        codec: of sensors that name none: ``auto``, ``raw``, ``jpeg`` or ``png``.
        reconnect: seconds for which a lost connection is tried again; 0 gives up at once.
    """

    scene: str | None = None
    scenario: str | None = None
    session_id: str | None = None
    token: str | None = None
    role: str = "controller"
    codec: str = "auto"
    reconnect: float = 60.0


class SessionBase:
    """What both twins know of their session."""

    def __init__(self, target: Target, plan: SessionPlan) -> None:
        self._target = target
        self._plan = plan
        self._codec = target.codec(plan.codec)
        self._conversation = ProtocolState()
        self._welcome: Welcome | None = None
        self._result: Result | None = None
        self._token = plan.token

    def __repr__(self) -> str:
        name = self._welcome.session_id if self._welcome else self._plan.session_id
        return f"{type(self).__name__}({name!r}, step={self._conversation.step})"

    @property
    def welcome(self) -> Welcome:
        """What the worker said at the start: cameras, objects, time range, limits, versions.

        Raises:
            NotOpenError: the session was not opened yet.
        """
        if self._welcome is None:
            raise NotOpenError(
                "the session is not open", hint="use it as `with client.session(...) as s:`"
            )
        return self._welcome

    @property
    def session_id(self) -> str:
        """Id of the session on its worker."""
        return self.welcome.session_id

    @property
    def token(self) -> str:
        """Authorises others to join this session: ``client.join(s.session_id, token=s.token)``."""
        if self._token is None:
            raise NotOpenError(
                "the session is not open", hint="use it as `with client.session(...) as s:`"
            )
        return self._token

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras that can be sensors."""
        return [camera.name for camera in self.welcome.cameras]

    @property
    def result(self) -> Result | None:
        """Final scores; known after ``close``."""
        return self._result

    def _hello(self) -> PendingRequest[Welcome]:
        resume_token = self._welcome.resume_token if self._welcome else None
        return self._conversation.hello(
            sdk=SDK, role=self._plan.role, token=self._token, resume_token=resume_token
        )

    def _comes_back(self, question: PendingRequest[Any]) -> bool:
        """Whether it is worth connecting again for the sake of a question."""
        return self._welcome is not None and self._plan.reconnect > 0 and question.repeatable

    def _check_repeatable(self, question: PendingRequest[Any]) -> None:
        """Raises ConnectionLostError when the question may have taken effect already."""
        if question.only_at is not None and self.welcome.revision != question.only_at:
            raise ConnectionLostError(
                f"the connection was lost while {question.awaited} was awaited; the session is at "
                f"revision {self.welcome.revision} now, so it took effect",
                hint="the session goes on; look at the next observation",
            )

    def _seconds(self, question: PendingRequest[Any]) -> float:
        return self._target.patience if question.patient else self._target.timeout

    def _late(self, question: PendingRequest[Any]) -> ReplyTimeoutError:
        return ReplyTimeoutError(
            f"{question.awaited} from {self._target.url}",
            self._seconds(question),
            hint="the worker may be busy; see `real2sim status`, or give a longer timeout",
        )


class DriveSession(SessionBase):
    """``with client.session(scene=...) as s: obs = s.reset(); obs = s.step(plan)``."""

    def __init__(self, transport: Transport, plan: SessionPlan) -> None:
        super().__init__(transport.target, plan)
        self._transport = transport
        self._socket: Socket | None = None
        self._line = contextlib.ExitStack()
        self._info: SessionInfo | None = None

    def open(self) -> Self:
        """Create or join the session and shake hands; loading is over when this returns."""
        session_id = self._plan.session_id
        if session_id is None:
            call = _requests.create_session(self._plan.scene, self._plan.scenario, None)
            self._info = self._transport.send(call)
            session_id, self._token = self._info.session_id, self._info.token
        try:
            self._connect(session_id)
        except BaseException:
            self._shut()
            raise
        return self

    def reset(
        self, *, sensors: Sequence[Sensor] = (), **options: Unpack[ResetOptions]
    ) -> Observation:
        """Start an episode and return its first observation.

        Args:
            sensors: camera names or specs; what every observation shows.
            options: seed, start_us, dt_us, horizon, ego, action, agents, privileged, deadline_ms,
                on_timeout, latency, on_collision and more; see
                ``real2sim_proto.episode.ResetSpec``.
        """
        spec = reset_spec(sensors, self._codec, options)
        return observation_from_wire(self._ask(self._conversation.reset(spec)))

    def step(self, plan: Plan | Mapping[str, Any]) -> Observation:
        """Send the plan for the newest observation; returns the next one.

        After a ReplyTimeoutError the same plan may be sent again: the worker moves only once. A
        plan that misses the episode's deadline is not applied; the observation that the worker
        went on to is returned, with a ``deadline_missed`` event.
        """
        return observation_from_wire(self._ask(self._conversation.action(plan)))

    def receive(self, timeout: float | None = None) -> Observation:
        """The next observation that comes unasked: what an observer sees of the controller's loop.

        Args:
            timeout: seconds to wait; default: the client's.

        Raises:
            ReplyTimeoutError: none came in time.
        """
        seconds = self._target.timeout if timeout is None else timeout
        until = time.monotonic() + seconds
        while (message := self._conversation.unasked()) is None:
            with lost_connection(self._target, "an observation"):
                try:
                    data = self._open_socket().recv(timeout=max(until - time.monotonic(), 0.0))
                except TimeoutError:
                    raise ReplyTimeoutError("observation", seconds) from None
            self._conversation.hear(data)
        return observation_from_wire(message)

    def edit(self, operations: Sequence[Operation | Mapping[str, Any]]) -> Edited:
        """Change this session's world before the next step; all operations apply, or none."""
        return self._ask(self._conversation.edit(operations))

    def render(self, sensors: Sequence[Sensor]) -> View:
        """Images of the current instant; never moves time."""
        view = self._ask(self._conversation.render(sensor_specs(sensors, self._codec)))
        return view_from_frames(
            view.frames, t_us=view.t_us, revision=view.revision, timing=view.timing
        )

    def steer(
        self,
        object_id: str,
        times_us: Sequence[int],
        poses: Sequence[tuple[float, float, float]],
    ) -> int:
        """Drive an object whose driver is ``external``; from which step on the plan holds.

        Args:
            object_id: named as external in ``reset(agents=...)``.
            times_us: [N] absolute simulation times after the newest observation [us].
            poses: [N] x [m], y [m], yaw [rad] of its box, world.
        """
        return self._ask(self._conversation.agent(object_id, times_us, poses)).step

    def snapshot(self, name: str) -> Kept:
        """Keep the present instant under a name, to return to by :meth:`restore`."""
        return self._ask(self._conversation.snapshot(name))

    def restore(self, name: str) -> Observation:
        """Go back to a snapshot; its observation."""
        return observation_from_wire(self._ask(self._conversation.restore(name)))

    def fork(self) -> Forked:
        """Another session that goes on from this instant: ``client.join(f.session_id,
        token=f.token)``."""
        return self._ask(self._conversation.fork())

    def save_recording(self, path: Path | str, *, frames: bool = False) -> Path:
        """Write the running episode to a file, to be replayed and scored again.

        Args:
            path: for example ``drive.r2e``.
            frames: whether the images of its sensors are drawn once more and kept too.
        """
        call = _requests.record_session(self.session_id, self._token, frames)
        write_atomically(Path(path), self._transport.send(call))
        return Path(path)

    def close(self) -> Result | None:
        """End a session that this handle made, or leave one that it joined; idempotent.

        Returns:
            Final scores, where the worker could still tell them.
        """
        if self._socket is not None and self._plan.session_id is None:
            # Whoever closes wants to go; a worker that is gone already must not hold them up.
            with contextlib.suppress(Real2SimError):
                self._result = self._ask(self._conversation.bye())
        self._shut()
        return self._result

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _connect(self, session_id: str) -> None:
        with handshake_errors(self._target):
            line = connect(**socket_options(self._target, session_id))
            self._socket = self._line.enter_context(line)
        check_subprotocol(self._socket.subprotocol)
        self._welcome = self._exchange(self._hello())

    def _reconnect(self) -> None:
        """Connect again, for as long as the plan says; the worker may be starting anew."""
        session_id, until = self.session_id, time.monotonic() + self._plan.reconnect
        for attempt in range(10_000):
            self._hang_up()
            try:
                return self._connect(session_id)
            except COMING_BACK:
                wait = backoff(attempt)
                if time.monotonic() + wait > until:
                    raise
                time.sleep(wait)
        return None

    def _ask(self, question: PendingRequest[A]) -> A:
        try:
            return self._exchange(question)
        except ConnectionLostError:
            if not self._comes_back(question):
                raise
            self._reconnect()
            self._check_repeatable(question)
            return self._exchange(question)

    def _exchange(self, question: PendingRequest[A]) -> A:
        socket = self._open_socket()
        seconds = self._seconds(question)
        with lost_connection(self._target, question.awaited):
            socket.send(question.data)
            while True:
                try:
                    data = socket.recv(timeout=seconds)
                except TimeoutError:
                    raise self._late(question) from None
                if (answer := self._conversation.read(data, question)) is not None:
                    return answer

    def _open_socket(self) -> Socket:
        if self._socket is None:
            raise NotOpenError(
                "the session is not open", hint="use it as `with client.session(...) as s:`"
            )
        return self._socket

    def _hang_up(self) -> None:
        with contextlib.suppress(OSError, websockets.exceptions.WebSocketException):
            self._line.close()

    def _shut(self) -> None:
        self._hang_up()
        self._socket = None
        if self._info is not None and self._result is None:
            token = self._target.token or self._info.token
            with contextlib.suppress(Real2SimError):
                self._transport.send(_requests.delete_session(self._info.session_id, token))
        self._info = None
