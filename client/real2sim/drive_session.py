"""Driving a session over its socket, in lock step: one plan, one observation.

A session is used by one thread or task at a time.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar, Unpack

from websockets.asyncio.client import connect as connect_async
from websockets.sync.client import connect

from real2sim_proto.drive import Edited, Envelope, Plan, Result, Welcome
from real2sim_proto.operations import Operation
from real2sim_proto.sessions import SessionInfo

from . import _requests
from ._conversation import Conversation, Question
from ._drive_socket import check_subprotocol, handshake_errors, lost_connection, socket_options
from ._sensors import ResetOptions, Sensor, reset_spec, sensor_specs
from ._transport import AsyncTransport, Target, Transport
from .errors import (
    NotOpenError,
    Real2SimError,
    ReplyTimeoutError,
)
from .observation import Observation, View, observation_from_wire, view_from_frames
from .version import SDK

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection as AsyncSocket
    from websockets.sync.client import ClientConnection as Socket

A = TypeVar("A", bound=Envelope)


@dataclass(frozen=True)
class SessionPlan:
    """Which session to open and how.

    Attributes:
        scene, scenario: what a new session runs on; exactly one of them.
        session_id: joins this session instead of making one.
        token: of the session that is joined.
        role: ``controller`` or ``observer``.
        codec: of sensors that name none: ``auto``, ``raw``, ``jpeg`` or ``png``.
    """

    scene: str | None = None
    scenario: str | None = None
    session_id: str | None = None
    token: str | None = None
    role: str = "controller"
    codec: str = "auto"


class SessionBase:
    """What both twins know of their session."""

    def __init__(self, target: Target, plan: SessionPlan) -> None:
        self._target = target
        self._plan = plan
        self._codec = target.codec(plan.codec)
        self._conversation = Conversation()
        self._welcome: Welcome | None = None
        self._result: Result | None = None

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
    def cameras(self) -> list[str]:
        """Names of the cameras that can be sensors."""
        return [camera.name for camera in self.welcome.cameras]

    @property
    def result(self) -> Result | None:
        """Final scores; known after ``close``."""
        return self._result

    def _hello(self, token: str | None) -> Question[Welcome]:
        return self._conversation.hello(sdk=SDK, role=self._plan.role, token=token)

    def _seconds(self, question: Question[Any]) -> float:
        return self._target.patience if question.patient else self._target.timeout

    def _late(self, question: Question[Any]) -> ReplyTimeoutError:
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
        self._stack = contextlib.ExitStack()

    def open(self) -> Self:
        """Create or join the session and shake hands; loading is over when this returns."""
        session_id, token = self._plan.session_id, self._plan.token
        if session_id is None:
            call = _requests.create_session(self._plan.scene, self._plan.scenario, None)
            info = self._transport.send(call)
            session_id, token = info.session_id, info.token
            self._stack.callback(self._delete, info)
        try:
            with handshake_errors(self._target):
                self._socket = self._stack.enter_context(
                    connect(**socket_options(self._target, session_id))
                )
            check_subprotocol(self._socket.subprotocol)
            self._welcome = self._ask(self._hello(token))
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
            options: seed, start_us, dt_us, horizon, ego, action, privileged, on_collision; see
                ``real2sim_proto.drive.ResetSpec``.
        """
        spec = reset_spec(sensors, self._codec, options)
        return observation_from_wire(self._ask(self._conversation.reset(spec)))

    def step(self, plan: Plan | Mapping[str, Any]) -> Observation:
        """Send the plan for the newest observation; returns the next one.

        After a ReplyTimeoutError the same plan may be sent again: the worker moves only once.
        """
        return observation_from_wire(self._ask(self._conversation.action(plan)))

    def edit(self, operations: Sequence[Operation | Mapping[str, Any]]) -> Edited:
        """Change this session's world before the next step; all operations apply, or none."""
        return self._ask(self._conversation.edit(operations))

    def render(self, sensors: Sequence[Sensor]) -> View:
        """Images of the current instant; never moves time."""
        view = self._ask(self._conversation.render(sensor_specs(sensors, self._codec)))
        return view_from_frames(
            view.frames, t_us=view.t_us, revision=view.revision, timing=view.timing
        )

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

    def _ask(self, question: Question[A]) -> A:
        socket = self._open_socket()
        seconds = self._seconds(question)
        with lost_connection(self._target, question):
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

    def _shut(self) -> None:
        self._socket = None
        self._stack.close()

    def _delete(self, info: SessionInfo) -> None:
        if self._result is None:
            token = self._target.token or info.token
            with contextlib.suppress(Real2SimError):
                self._transport.send(_requests.delete_session(info.session_id, token))


class AsyncDriveSession(SessionBase):
    """``async with client.session(scene=...) as s: obs = await s.reset()``; see DriveSession."""

    def __init__(self, transport: AsyncTransport, plan: SessionPlan) -> None:
        super().__init__(transport.target, plan)
        self._transport = transport
        self._socket: AsyncSocket | None = None
        self._stack = contextlib.AsyncExitStack()

    async def open(self) -> Self:
        """Create or join the session and shake hands; loading is over when this returns."""
        session_id, token = self._plan.session_id, self._plan.token
        if session_id is None:
            call = _requests.create_session(self._plan.scene, self._plan.scenario, None)
            info = await self._transport.send(call)
            session_id, token = info.session_id, info.token
            self._stack.push_async_callback(self._delete, info)
        try:
            with handshake_errors(self._target):
                self._socket = await self._stack.enter_async_context(
                    connect_async(**socket_options(self._target, session_id))
                )
            check_subprotocol(self._socket.subprotocol)
            self._welcome = await self._ask(self._hello(token))
        except BaseException:
            await self._shut()
            raise
        return self

    async def reset(
        self, *, sensors: Sequence[Sensor] = (), **options: Unpack[ResetOptions]
    ) -> Observation:
        """Start an episode and return its first observation; see :meth:`DriveSession.reset`."""
        spec = reset_spec(sensors, self._codec, options)
        return observation_from_wire(await self._ask(self._conversation.reset(spec)))

    async def step(self, plan: Plan | Mapping[str, Any]) -> Observation:
        """Send the plan for the newest observation; returns the next one."""
        return observation_from_wire(await self._ask(self._conversation.action(plan)))

    async def edit(self, operations: Sequence[Operation | Mapping[str, Any]]) -> Edited:
        """Change this session's world before the next step; all operations apply, or none."""
        return await self._ask(self._conversation.edit(operations))

    async def render(self, sensors: Sequence[Sensor]) -> View:
        """Images of the current instant; never moves time."""
        view = await self._ask(self._conversation.render(sensor_specs(sensors, self._codec)))
        return view_from_frames(
            view.frames, t_us=view.t_us, revision=view.revision, timing=view.timing
        )

    async def close(self) -> Result | None:
        """End a session that this handle made, or leave one that it joined; idempotent."""
        if self._socket is not None and self._plan.session_id is None:
            # Whoever closes wants to go; a worker that is gone already must not hold them up.
            with contextlib.suppress(Real2SimError):
                self._result = await self._ask(self._conversation.bye())
        await self._shut()
        return self._result

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()

    async def _ask(self, question: Question[A]) -> A:
        socket = self._open_socket()
        seconds = self._seconds(question)
        with lost_connection(self._target, question):
            await socket.send(question.data)
            while True:
                try:
                    async with asyncio.timeout(seconds):
                        data = await socket.recv()
                except TimeoutError:
                    raise self._late(question) from None
                if (answer := self._conversation.read(data, question)) is not None:
                    return answer

    def _open_socket(self) -> AsyncSocket:
        if self._socket is None:
            raise NotOpenError(
                "the session is not open", hint="use it as `async with client.session(...) as s:`"
            )
        return self._socket

    async def _shut(self) -> None:
        self._socket = None
        await self._stack.aclose()

    async def _delete(self, info: SessionInfo) -> None:
        if self._result is None:
            token = self._target.token or info.token
            with contextlib.suppress(Real2SimError):
                await self._transport.send(_requests.delete_session(info.session_id, token))
