# Made from _async/sessions.py by scripts/unasync.py; edit that file, then run the script.
"""Sessions by plain requests, for scripts that need no socket."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Unpack

from real2sim_proto.plans import Plan
from real2sim_proto.sessions import SessionCreate, SessionInfo, SessionState, StepRequest

from .. import _requests
from .._call import checked
from .._references import ScenarioRef, SceneRef, optional_scenario_id, optional_scene_name
from .._sensors import (
    LidarSensor,
    RadarSensor,
    ResetOptions,
    Sensor,
    ranging_specs,
    reset_spec,
    sensor_specs,
)
from .._session_state import SessionTokens
from ..observation import View
from .collection import Collection
from .transport import Transport


class Sessions(Collection[SessionInfo]):
    """``client.sessions``.

    Examples:
        >>> client = real2sim.connect()
        >>> info = client.sessions.create(scene="street", sensors=["front"], seed=3)
    """

    def __init__(self, transport: Transport) -> None:
        super().__init__(transport)
        self._tokens = SessionTokens(transport.target.token)

    def create(
        self,
        *,
        scene: SceneRef | None = None,
        scenario: ScenarioRef | None = None,
        sensors: Sequence[Sensor] = (),
        **options: Unpack[ResetOptions],
    ) -> SessionInfo:
        """A new session, its episode started.

        Args:
            scene, scenario: exactly one of them, or its name or id.
            sensors: as of ``DriveSession.reset``.
            options: as of ``DriveSession.reset``.

        Examples:
            >>> info = client.sessions.create(scene="street", dt_us=50_000)
            >>> info.step, info.reset.dt_us
            (0, 50000)
        """
        spec = reset_spec(sensors, self._transport.target.codec("auto"), options)
        call = _requests.create_session(
            optional_scene_name(scene), optional_scenario_id(scenario), SessionCreate(reset=spec)
        )
        return self._tokens.keep(self._transport.send(call))

    def list(self) -> Sequence[SessionInfo]:
        """All sessions of the worker.

        Examples:
            >>> info.session_id in [session.session_id for session in client.sessions.list()]
            True
        """
        found = self._transport.send(_requests.list_sessions())
        return found.sessions

    def get(self, session_id: str) -> SessionInfo:
        """One session.

        Raises:
            NotFoundError: no such session.

        Examples:
            >>> (client.sessions.get(info.session_id)).scene
            'street'
        """
        call = _requests.get_session(session_id, self._tokens.of(session_id))
        return self._transport.send(call)

    def delete(self, session_id: str) -> None:
        """End a session.

        Examples:
            >>> client.sessions.delete(info.session_id)
        """
        call = _requests.delete_session(session_id, self._tokens.of(session_id))
        self._transport.send(call)
        self._tokens.forget(session_id)

    def step(
        self, session_id: str, *, n: int = 1, plan: Plan | Mapping[str, Any] | None = None
    ) -> SessionState:
        """``n`` clock steps under one plan; default: the last plan, else along the log.

        Examples:
            >>> state = client.sessions.step(info.session_id, n=5)
            >>> state.step, state.t_us
            (5, 500000)
        """
        body = checked(StepRequest, n=n, plan=plan)
        call = _requests.step_session(session_id, self._tokens.of(session_id), body)
        return self._transport.send(call)

    def state(self, session_id: str) -> SessionState:
        """Where everything is now.

        Examples:
            >>> state = client.sessions.state(info.session_id)
            >>> state.step, round(state.ego.speed, 3)
            (0, 5.0)
        """
        call = _requests.session_state(session_id, self._tokens.of(session_id))
        return self._transport.send(call)

    def render(
        self,
        session_id: str,
        sensors: Sequence[Sensor] = (),
        *,
        lidars: Sequence[LidarSensor] = (),
        radars: Sequence[RadarSensor] = (),
        codec: str = "auto",
    ) -> View:
        """Images of the current instant; never moves time.

        Examples:
            >>> view = client.sessions.render(info.session_id, ["front"])
            >>> view.image("front").shape
            (64, 96, 3)
        """
        specs = sensor_specs(sensors, self._transport.target.codec(codec))
        ranging = ranging_specs(lidars, radars)
        call = _requests.render_session(session_id, self._tokens.of(session_id), specs, ranging)
        return self._transport.send(call)
