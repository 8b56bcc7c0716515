"""Sessions by plain requests, for scripts that need no socket."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Unpack

from real2sim_proto.jobs import DriveRequest
from real2sim_proto.plans import Plan
from real2sim_proto.sessions import (
    SessionClock,
    SessionCreate,
    SessionInfo,
    SessionState,
    StepRequest,
)

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
from .collection import AsyncCollection
from .jobs import AsyncJob
from .transport import AsyncTransport


class AsyncSessions(AsyncCollection[SessionInfo]):
    """``client.sessions``.

    Examples:
        >>> client = real2sim.connect_async()
        >>> info = await client.sessions.create(scene="street", sensors=["front"], seed=3)
    """

    def __init__(self, transport: AsyncTransport) -> None:
        super().__init__(transport)
        self._tokens = SessionTokens(transport.target.token)

    async def create(
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
            >>> info = await client.sessions.create(scene="street", dt_us=50_000)
            >>> info.step, info.reset.dt_us
            (0, 50000)
        """
        spec = reset_spec(sensors, self._transport.target.codec("auto"), options)
        call = _requests.create_session(
            optional_scene_name(scene), optional_scenario_id(scenario), SessionCreate(reset=spec)
        )
        return self._tokens.keep(await self._transport.send(call))

    async def list(self) -> Sequence[SessionInfo]:
        """All sessions of the worker.

        Examples:
            >>> info.session_id in [session.session_id for session in await client.sessions.list()]
            True
        """
        found = await self._transport.send(_requests.list_sessions())
        return found.sessions

    async def get(self, session_id: str) -> SessionInfo:
        """One session.

        Raises:
            NotFoundError: no such session.

        Examples:
            >>> (await client.sessions.get(info.session_id)).scene
            'street'
        """
        call = _requests.get_session(session_id, self._tokens.of(session_id))
        return await self._transport.send(call)

    async def delete(self, session_id: str) -> None:
        """End a session.

        Examples:
            >>> await client.sessions.delete(info.session_id)
        """
        call = _requests.delete_session(session_id, self._tokens.of(session_id))
        await self._transport.send(call)
        self._tokens.forget(session_id)

    async def step(
        self, session_id: str, *, n: int = 1, plan: Plan | Mapping[str, Any] | None = None
    ) -> SessionState:
        """``n`` clock steps under one plan; default: the last plan, else along the log.

        Examples:
            >>> state = await client.sessions.step(info.session_id, n=5)
            >>> state.step, state.t_us
            (5, 500000)
        """
        body = checked(StepRequest, n=n, plan=plan)
        call = _requests.step_session(session_id, self._tokens.of(session_id), body)
        return await self._transport.send(call)

    async def state(self, session_id: str, *, after: int | None = None) -> SessionState:
        """Where everything is now, and the newest plan.

        Args:
            session_id: of the session.
            after: wait until the clock has left this step, 10 s at most.

        Examples:
            >>> state = await client.sessions.state(info.session_id)
            >>> state.step, round(state.ego.speed, 3)
            (0, 5.0)
        """
        call = _requests.session_state(session_id, self._tokens.of(session_id), after)
        return await self._transport.send(call)

    async def drive(
        self, session_id: str, planner: str | None = "follow_route", *, steps: int | None = None
    ) -> AsyncJob:
        """Let a planner drive the session: a job that leaves a recording and ``playback.json``.

        Args:
            session_id: of the session; it stays.
            planner: of the SDK, by name, from a reset on; None waits for one of yours, on the drive
                socket or by :meth:`step`.
            steps: of the episode; default: to its end.

        Raises:
            ConflictError: somebody drives it already.

        Examples:
            >>> job = await client.sessions.drive(info.session_id, planner=None, steps=3)
            >>> state = await client.sessions.step(info.session_id, n=3)
            >>> (await job.wait()).result["steps"]
            3
        """
        body = checked(DriveRequest, planner=planner, steps=steps)
        call = _requests.drive_session(session_id, self._tokens.of(session_id), body)
        return AsyncJob(self._transport, await self._transport.send(call))

    async def set_clock(
        self,
        session_id: str,
        state: str,
        *,
        steps: int | None = None,
        pace: float | None = None,
    ) -> SessionInfo:
        """Hold the clock while a planner drives, let it go, or end the episode.

        Args:
            session_id: of the session.
            state: "held", "running" or "ended".
            steps: of "held": so many more before it holds.
            pace: of "running": simulated seconds in a second; default: as fast as it can.

        Examples:
            >>> (await client.sessions.set_clock(info.session_id, "held")).held
            True
            >>> (await client.sessions.set_clock(info.session_id, "running", pace=1.0)).held
            False
        """
        body = checked(SessionClock, state=state, steps=steps, pace=pace)
        call = _requests.session_clock(session_id, self._tokens.of(session_id), body)
        return await self._transport.send(call)

    async def fork(self, session_id: str, *, step: int | None = None) -> SessionInfo:
        """A new session that goes on from an instant of this one.

        Args:
            session_id: of the session.
            step: of the running episode; default: the present one.

        Examples:
            >>> state = await client.sessions.step(info.session_id, n=4)
            >>> (await client.sessions.fork(info.session_id, step=2)).step
            2
        """
        call = _requests.fork_session(session_id, self._tokens.of(session_id), step)
        return self._tokens.keep(await self._transport.send(call))

    async def render(
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
            >>> view = await client.sessions.render(info.session_id, ["front"])
            >>> view.image("front").shape
            (64, 96, 3)
        """
        specs = sensor_specs(sensors, self._transport.target.codec(codec))
        ranging = ranging_specs(lidars, radars)
        call = _requests.render_session(session_id, self._tokens.of(session_id), specs, ranging)
        return await self._transport.send(call)
