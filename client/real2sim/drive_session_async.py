"""The async twin of the drive session."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar, Unpack

import websockets
from websockets.asyncio.client import connect

from real2sim_proto.drive import Edited, Envelope, Forked, Kept, Result
from real2sim_proto.operations import Operation
from real2sim_proto.plans import Plan
from real2sim_proto.sessions import SessionInfo

from . import _requests
from ._conversation import PendingRequest
from ._drive_socket import check_subprotocol, handshake_errors, lost_connection, socket_options
from ._sensors import ResetOptions, Sensor, reset_spec, sensor_specs
from ._transport import AsyncTransport
from .drive_session import COMING_BACK, SessionBase, SessionPlan, backoff
from .errors import ConnectionLostError, NotOpenError, Real2SimError, ReplyTimeoutError
from .images import write_atomically
from .observation import Observation, View, observation_from_wire, view_from_frames

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection as AsyncSocket

A = TypeVar("A", bound=Envelope)


class AsyncDriveSession(SessionBase):
    """``async with client.session(scene=...) as s: obs = await s.reset()``; see DriveSession."""

    def __init__(self, transport: AsyncTransport, plan: SessionPlan) -> None:
        super().__init__(transport.target, plan)
        self._transport = transport
        self._socket: AsyncSocket | None = None
        self._line = contextlib.AsyncExitStack()
        self._info: SessionInfo | None = None

    async def open(self) -> Self:
        """Create or join the session and shake hands; loading is over when this returns."""
        session_id = self._plan.session_id
        if session_id is None:
            call = _requests.create_session(self._plan.scene, self._plan.scenario, None)
            self._info = await self._transport.send(call)
            session_id, self._token = self._info.session_id, self._info.token
        try:
            await self._connect(session_id)
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

    async def receive(self, timeout: float | None = None) -> Observation:
        """The next observation that comes unasked; see :meth:`DriveSession.receive`."""
        seconds = self._target.timeout if timeout is None else timeout
        until = time.monotonic() + seconds
        while (message := self._conversation.unasked()) is None:
            with lost_connection(self._target, "an observation"):
                try:
                    async with asyncio.timeout(max(until - time.monotonic(), 0.0)):
                        data = await self._open_socket().recv()
                except TimeoutError:
                    raise ReplyTimeoutError("observation", seconds) from None
            self._conversation.hear(data)
        return observation_from_wire(message)

    async def edit(self, operations: Sequence[Operation | Mapping[str, Any]]) -> Edited:
        """Change this session's world before the next step; all operations apply, or none."""
        return await self._ask(self._conversation.edit(operations))

    async def render(self, sensors: Sequence[Sensor]) -> View:
        """Images of the current instant; never moves time."""
        view = await self._ask(self._conversation.render(sensor_specs(sensors, self._codec)))
        return view_from_frames(
            view.frames, t_us=view.t_us, revision=view.revision, timing=view.timing
        )

    async def steer(
        self,
        object_id: str,
        times_us: Sequence[int],
        poses: Sequence[tuple[float, float, float]],
    ) -> int:
        """Drive an object whose driver is ``external``; see :meth:`DriveSession.steer`."""
        return (await self._ask(self._conversation.agent(object_id, times_us, poses))).step

    async def snapshot(self, name: str) -> Kept:
        """Keep the present instant under a name, to return to by :meth:`restore`."""
        return await self._ask(self._conversation.snapshot(name))

    async def restore(self, name: str) -> Observation:
        """Go back to a snapshot; its observation."""
        return observation_from_wire(await self._ask(self._conversation.restore(name)))

    async def fork(self) -> Forked:
        """Another session that goes on from this instant; see :meth:`DriveSession.fork`."""
        return await self._ask(self._conversation.fork())

    async def save_recording(self, path: Path | str, *, frames: bool = False) -> Path:
        """Write the running episode to a file; see :meth:`DriveSession.save_recording`."""
        call = _requests.record_session(self.session_id, self._token, frames)
        write_atomically(Path(path), await self._transport.send(call))
        return Path(path)

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

    async def _connect(self, session_id: str) -> None:
        with handshake_errors(self._target):
            line = connect(**socket_options(self._target, session_id))
            self._socket = await self._line.enter_async_context(line)
        check_subprotocol(self._socket.subprotocol)
        self._welcome = await self._exchange(self._hello())

    async def _reconnect(self) -> None:
        """Connect again, for as long as the plan says; the worker may be starting anew."""
        session_id, until = self.session_id, time.monotonic() + self._plan.reconnect
        for attempt in range(10_000):
            await self._hang_up()
            try:
                return await self._connect(session_id)
            except COMING_BACK:
                wait = backoff(attempt)
                if time.monotonic() + wait > until:
                    raise
                await asyncio.sleep(wait)
        return None

    async def _ask(self, question: PendingRequest[A]) -> A:
        try:
            return await self._exchange(question)
        except ConnectionLostError:
            if not self._comes_back(question):
                raise
            await self._reconnect()
            self._check_repeatable(question)
            return await self._exchange(question)

    async def _exchange(self, question: PendingRequest[A]) -> A:
        socket = self._open_socket()
        seconds = self._seconds(question)
        with lost_connection(self._target, question.awaited):
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

    async def _hang_up(self) -> None:
        with contextlib.suppress(OSError, websockets.exceptions.WebSocketException):
            await self._line.aclose()

    async def _shut(self) -> None:
        await self._hang_up()
        self._socket = None
        if self._info is not None and self._result is None:
            token = self._target.token or self._info.token
            with contextlib.suppress(Real2SimError):
                await self._transport.send(_requests.delete_session(self._info.session_id, token))
        self._info = None
