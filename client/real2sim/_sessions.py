"""Sessions by plain requests, for scripts that need no socket."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Unpack

from real2sim_proto.plans import Plan
from real2sim_proto.sessions import SessionCreate, SessionInfo, SessionState, StepRequest

from . import _requests
from ._call import checked
from ._sensors import ResetOptions, Sensor, reset_spec, sensor_specs
from ._transport import AsyncTransport, Transport
from .observation import View


class SessionTokens:
    """Tokens of the sessions that this client created; the worker tells them only once."""

    def __init__(self, own: str | None) -> None:
        self._own = own
        self._tokens: dict[str, str] = {}

    def keep(self, info: SessionInfo) -> SessionInfo:
        self._tokens[info.session_id] = info.token
        return info

    def forget(self, session_id: str) -> None:
        self._tokens.pop(session_id, None)

    def of(self, session_id: str) -> str | None:
        """The worker's own token goes before a session's; it opens every session."""
        return self._own or self._tokens.get(session_id)


class Sessions:
    """``client.sessions``."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._tokens = SessionTokens(transport.target.token)

    def create(
        self,
        *,
        scene: str | None = None,
        scenario: str | None = None,
        sensors: Sequence[Sensor] = (),
        **options: Unpack[ResetOptions],
    ) -> SessionInfo:
        """A new session, its episode started; sensors and options as of ``DriveSession.reset``."""
        body = _session_body(self._transport.target.codec("auto"), sensors, options)
        call = _requests.create_session(scene, scenario, body)
        return self._tokens.keep(self._transport.send(call))

    def list(self) -> Sequence[SessionInfo]:
        """All sessions of the worker."""
        return self._transport.send(_requests.list_sessions()).sessions

    def get(self, session_id: str) -> SessionInfo:
        """One session."""
        call = _requests.get_session(session_id, self._tokens.of(session_id))
        return self._transport.send(call)

    def delete(self, session_id: str) -> None:
        """End a session."""
        self._transport.send(_requests.delete_session(session_id, self._tokens.of(session_id)))
        self._tokens.forget(session_id)

    def step(
        self, session_id: str, *, n: int = 1, plan: Plan | Mapping[str, Any] | None = None
    ) -> SessionState:
        """``n`` clock steps under one plan; default: the last plan, else along the log."""
        body = checked(StepRequest, n=n, plan=plan)
        call = _requests.step_session(session_id, self._tokens.of(session_id), body)
        return self._transport.send(call)

    def state(self, session_id: str) -> SessionState:
        """Where everything is now."""
        call = _requests.session_state(session_id, self._tokens.of(session_id))
        return self._transport.send(call)

    def render(self, session_id: str, sensors: Sequence[Sensor], *, codec: str = "auto") -> View:
        """Images of the current instant; never moves time."""
        specs = sensor_specs(sensors, self._transport.target.codec(codec))
        call = _requests.render_session(session_id, self._tokens.of(session_id), specs)
        return self._transport.send(call)


class AsyncSessions:
    """``client.sessions`` of the async client; see :class:`Sessions`."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport
        self._tokens = SessionTokens(transport.target.token)

    async def create(
        self,
        *,
        scene: str | None = None,
        scenario: str | None = None,
        sensors: Sequence[Sensor] = (),
        **options: Unpack[ResetOptions],
    ) -> SessionInfo:
        """A new session, its episode started; sensors and options as of ``DriveSession.reset``."""
        body = _session_body(self._transport.target.codec("auto"), sensors, options)
        call = _requests.create_session(scene, scenario, body)
        return self._tokens.keep(await self._transport.send(call))

    async def list(self) -> Sequence[SessionInfo]:
        """All sessions of the worker."""
        return (await self._transport.send(_requests.list_sessions())).sessions

    async def get(self, session_id: str) -> SessionInfo:
        """One session."""
        call = _requests.get_session(session_id, self._tokens.of(session_id))
        return await self._transport.send(call)

    async def delete(self, session_id: str) -> None:
        """End a session."""
        call = _requests.delete_session(session_id, self._tokens.of(session_id))
        await self._transport.send(call)
        self._tokens.forget(session_id)

    async def step(
        self, session_id: str, *, n: int = 1, plan: Plan | Mapping[str, Any] | None = None
    ) -> SessionState:
        """``n`` clock steps under one plan; default: the last plan, else along the log."""
        body = checked(StepRequest, n=n, plan=plan)
        call = _requests.step_session(session_id, self._tokens.of(session_id), body)
        return await self._transport.send(call)

    async def state(self, session_id: str) -> SessionState:
        """Where everything is now."""
        call = _requests.session_state(session_id, self._tokens.of(session_id))
        return await self._transport.send(call)

    async def render(
        self, session_id: str, sensors: Sequence[Sensor], *, codec: str = "auto"
    ) -> View:
        """Images of the current instant; never moves time."""
        specs = sensor_specs(sensors, self._transport.target.codec(codec))
        call = _requests.render_session(session_id, self._tokens.of(session_id), specs)
        return await self._transport.send(call)


def _session_body(codec: str, sensors: Sequence[Sensor], options: ResetOptions) -> SessionCreate:
    return SessionCreate(reset=reset_spec(sensors, codec, options))
