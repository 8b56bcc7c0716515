"""Drive sessions: over a socket in lockstep, or over REST.

Use a session from one thread or task at a time.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import websockets

from real2sim_proto.drive import Edited, Envelope, Forked, Kept, Obs, Result
from real2sim_proto.jobs import DriveRequest
from real2sim_proto.operations import Operation
from real2sim_proto.plans import Plan
from real2sim_proto.sessions import (
    SessionClock,
    SessionCreate,
    SessionInfo,
    SessionState,
    StepRequest,
)

from .. import _requests
from .._calls import checked
from .._handles import ScenarioRef, SceneRef, optional_scenario_id, optional_scene_name
from .._protocol import (
    PendingRequest,
    check_subprotocol,
    handshake_errors,
    lost_connection,
    socket_options,
)
from .._requests import (
    LidarSensor,
    RadarSensor,
    ResetOptions,
    Sensor,
    ranging_specs,
    reset_spec,
    sensor_specs,
)
from .._session_state import (
    LOST_ERRORS,
    SessionBase,
    SessionPlan,
    SessionTokens,
    is_away,
    is_passing,
    not_open,
)
from ..errors import Real2SimError, ReplyTimeoutError, StatusError
from ..images import write_atomically
from ..observation import Observation, View, observation_from_wire, view_from_frames
from .concurrency import AsyncSocket, connect_socket, receive, run_blocking
from .jobs import AsyncJob
from .transport import AsyncCollection, AsyncTransport, outlast, reconnect


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
        """Create a session and start its episode.

        Args:
            scene, scenario: exactly one of them, as an object, name or id.
            sensors: as in ``DriveSession.reset``.
            options: as in ``DriveSession.reset``.

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
        """Run ``n`` clock steps under one plan; default: the last plan, or else the recorded drive.

        Examples:
            >>> state = await client.sessions.step(info.session_id, n=5)
            >>> state.step, state.t_us
            (5, 500000)
        """
        body = checked(StepRequest, n=n, plan=plan)
        call = _requests.step_session(session_id, self._tokens.of(session_id), body)
        return await self._transport.send(call)

    async def state(self, session_id: str, *, after: int | None = None) -> SessionState:
        """Current poses of all objects, and the newest plan.

        Args:
            session_id: the session.
            after: wait until the clock has passed this step, 10 s at most.

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
        """Let a planner drive the session: a job that writes a recording and ``playback.json``.

        Args:
            session_id: the session; it stays open.
            planner: name of a planner of the SDK, which starts with a reset; None waits for your
                planner on the drive socket or in :meth:`step`.
            steps: number of steps; default: to the end of the episode.

        Raises:
            ConflictError: another planner already drives it.

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
        """Pause or resume the clock while a planner drives, or end the episode.

        Args:
            session_id: the session.
            state: "held", "running" or "ended".
            steps: with "held": number of steps to run before the clock pauses.
            pace: with "running": simulated seconds per second; default: as fast as possible.

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
        """Create a session that continues from one step of this session.

        Args:
            session_id: the session.
            step: step of the current episode; default: the newest.

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
        """Render images of the current step, without advancing it.

        Examples:
            >>> view = await client.sessions.render(info.session_id, ["front"])
            >>> view.image("front").shape
            (64, 96, 3)
        """
        specs = sensor_specs(sensors, self._transport.target.codec(codec))
        ranging = ranging_specs(lidars, radars)
        call = _requests.render_session(session_id, self._tokens.of(session_id), specs, ranging)
        return await self._transport.send(call)


# Driving over the socket: one plan, one observation.

A = TypeVar("A", bound=Envelope)


class AsyncDriveSession(SessionBase):
    """A session in lockstep, created by :meth:`AsyncClient.session`.

    Examples:
        >>> client = real2sim.connect_async()
        >>> session = await client.session(scene="street").open()
        >>> obs = await session.reset(seed=0, sensors=["front"])
        >>> obs.step, obs.image("front").shape
        (0, (64, 96, 3))

        As a context manager, ``async with client.session(scene="street") as session:`` closes it.
    """

    def __init__(self, transport: AsyncTransport, plan: SessionPlan) -> None:
        super().__init__(transport.target, plan)
        self._transport = transport
        self._socket: AsyncSocket | None = None
        self._socket_stack = contextlib.AsyncExitStack()

    async def open(self) -> Self:
        """Create or join the session, and return once the scene is loaded.

        Raises:
            UnreachableError: no worker responds.
            NotFoundError: no such scene, scenario or session.
            CapacityError: the worker is full.

        Examples:
            >>> other = await client.session(scene="street").open()
            >>> other.cameras
            ['front', 'left']
            >>> result = await other.close()
        """
        session_id = self._plan.session_id
        if session_id is None:
            call = _requests.create_session(self._plan.scene, self._plan.scenario, None)
            create = partial(self._transport.send, call)
            self._info = await outlast(create, seconds=self._plan.reconnect, passes=is_away)
            session_id, self._token = self._info.session_id, self._info.token
        try:
            await self._connect_first(session_id)
        except BaseException:
            await self._release()
            raise
        return self

    async def reset(
        self, *, sensors: Sequence[Sensor] = (), **options: Unpack[ResetOptions]
    ) -> Observation:
        """Start an episode and return its first observation.

        Args:
            sensors: camera names or specs to include in every observation.
            options: seed, start_us, dt_us, horizon, ego, action, agents, privileged, deadline_ms,
                on_timeout, latency, on_collision and more; see
                ``real2sim_proto.episode.ResetSpec``. ``lidars`` and ``radars`` are names in the
                worker's catalogues, or specs.

        Raises:
            ValueError: an invalid option.

        Examples:
            >>> obs = await session.reset(
            ...     seed=7,
            ...     sensors=[{"camera": "front", "modalities": ["rgb", "depth"], "width": 48}],
            ...     action="control",
            ...     privileged=True,
            ... )
            >>> obs.image("front", "depth").shape
            (32, 48)
            >>> sorted(agent.object_id for agent in obs.agents)
            ['car_blue', 'car_red', 'post']
            >>> obs = await session.reset(lidars=["vlp-16"], radars=["corner"])
            >>> sweep, scan = obs.lidar("vlp-16"), obs.radar("corner")
            >>> sweep.points.shape[1], sweep.t_us, scan.modality
            (3, 0, 'radar')
        """
        spec = reset_spec(sensors, self._codec, options)
        return await self._observe(self._protocol.reset(spec))

    async def step(self, plan: Plan | Mapping[str, Any]) -> Observation:
        """Send the plan for the newest observation; returns the next one.

        After a ReplyTimeoutError you may send the same plan again: the worker applies it only once.
        A plan that misses the episode's deadline is not applied; the worker advances, and its
        observation is returned with a ``deadline_missed`` event.

        Raises:
            NotResetError: no episode is running.
            InvalidActionError: the plan's kind differs from ``reset(action=...)``.
            EpisodeOverError: the episode has ended.

        Examples:
            >>> ahead = [obs.t_us + 500_000, obs.t_us + 1_000_000]
            >>> plan = real2sim.TrajectoryPlan(times_us=ahead, poses=[(2.5, 0, 0), (5, 0, 0)])
            >>> obs = await session.step(plan)
            >>> obs.step, obs.t_us
            (1, 100000)
        """
        return await self._observe(self._protocol.action(plan))

    async def receive(self, timeout: float | None = None) -> Observation:
        """The next unsolicited observation; observers receive the controller's observations.

        Args:
            timeout: seconds to wait; default: the client's.

        Raises:
            ReplyTimeoutError: none arrived in time.

        Examples:
            >>> spectator = client.join(session.session_id, token=session.token, role="observer")
            >>> spectator = await spectator.open()
            >>> plan = {"kind": "trajectory", "times_us": [1_000_000], "poses": [(5, 0, 0)]}
            >>> obs = await session.step(plan)
            >>> (await spectator.receive(timeout=10.0)).step
            1
            >>> await spectator.close()
        """
        seconds = self._target.timeout if timeout is None else timeout
        until = time.monotonic() + seconds
        while (message := self._protocol.take_unsolicited()) is None:
            with lost_connection(self._target, "an observation"):
                try:
                    data = await receive(self._open_socket(), max(until - time.monotonic(), 0.0))
                except TimeoutError:
                    raise ReplyTimeoutError("observation", seconds) from None
            self._protocol.handle_unsolicited(data)
        return observation_from_wire(message)

    async def edit(self, operations: Sequence[Operation | Mapping[str, Any]]) -> Edited:
        """Edit this session's world before the next step; all operations apply, or none.

        Raises:
            ValueError: an invalid operation.
            InvalidOperationError: an unknown object, or an invalid result.

        Examples:
            >>> edited = await session.edit([{"op": "duplicate", "object_id": "car_red", "x": 9.0}])
            >>> edited.created
            ['car_red_copy1']
        """
        return await self._request(self._protocol.edit(operations))

    async def render(
        self,
        sensors: Sequence[Sensor] = (),
        *,
        lidars: Sequence[LidarSensor] = (),
        radars: Sequence[RadarSensor] = (),
    ) -> View:
        """Render images and LiDAR and radar clouds of the current time, without advancing it.

        Examples:
            >>> view = await session.render(["left"])
            >>> view.image("left").shape
            (64, 96, 3)
            >>> view = await session.render(lidars=[{"lidar": "top", "model": "vlp-16"}])
            >>> view.lidar("top").frame
            'sensor'
        """
        asked = sensor_specs(sensors, self._codec), ranging_specs(lidars, radars)
        view = await self._request(self._protocol.render(*asked))
        return view_from_frames(
            view.frames,
            t_us=view.t_us,
            revision=view.revision,
            timing=view.timing,
            pixels=self._pixels_of(view.frames),
            clouds=view.clouds,
        )

    async def steer(
        self,
        object_id: str,
        times_us: Sequence[int],
        poses: Sequence[tuple[float, float, float]],
    ) -> int:
        """Drive an object whose driver is ``external``; returns the step at which the plan applies.

        Args:
            object_id: object set to external in ``reset(agents=...)``.
            times_us: [N] absolute simulation times after the newest observation [us].
            poses: [N] x [m], y [m], yaw [rad] of its box, world frame.

        Examples:
            >>> drivers = {"car_blue": {"kind": "external"}}
            >>> obs = await session.reset(agents={"drivers": drivers})
            >>> await session.steer("car_blue", [500_000, 1_000_000], [(10, 0, 0), (12, 1, 0.3)])
            0
        """
        driven = await self._request(self._protocol.agent(object_id, times_us, poses))
        return driven.step

    async def snapshot(self, name: str) -> Kept:
        """Save the current state under a name, to return to with :meth:`restore`.

        Examples:
            >>> kept = await session.snapshot("before")
            >>> kept.step
            0
        """
        return await self._request(self._protocol.snapshot(name))

    async def restore(self, name: str) -> Observation:
        """Return to a snapshot; returns its observation.

        Examples:
            >>> kept = await session.snapshot("before")
            >>> plan = {"kind": "trajectory", "times_us": [1_000_000], "poses": [(5, 0, 0)]}
            >>> obs = await session.step(plan)
            >>> (await session.restore("before")).step
            0
        """
        return await self._observe(self._protocol.restore(name))

    async def fork(self) -> Forked:
        """Create another session that continues from the current state.

        Examples:
            >>> forked = await session.fork()
            >>> branch = await client.join(forked.session_id, token=forked.token).open()
            >>> branch.session_id != session.session_id
            True
            >>> await branch.close()
        """
        return await self._request(self._protocol.fork())

    async def save_recording(self, path: Path | str, *, frames: bool = False) -> Path:
        """Write the current episode to a file, for replay and scoring.

        Args:
            path: for example ``drive.r2e``.
            frames: whether to render the images of its sensors again and include them.

        Examples:
            >>> path = await session.save_recording(folder / "drive.r2e")
            >>> path.stat().st_size > 0
            True
        """
        call = _requests.record_session(self.session_id, self._token, frames)
        await run_blocking(write_atomically, Path(path), await self._transport.send(call))
        return Path(path)

    async def close(self) -> Result | None:
        """End a session that this handle created, or leave one that it joined; idempotent.

        Returns:
            Final scores, if the worker was still able to compute them.

        Examples:
            >>> result = await session.close()
            >>> result.steps
            0
        """
        if self._socket is not None and self._plan.session_id is None:
            # A worker that has stopped must not block the close.
            with contextlib.suppress(Real2SimError):
                self._result = await self._request(self._protocol.bye())
        await self._release()
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

    async def _observe(self, request: PendingRequest[Obs]) -> Observation:
        obs = await self._request(request)
        return observation_from_wire(obs, self._pixels_of(obs.frames))

    async def _request(self, request: PendingRequest[A]) -> A:
        """The answer to a request, retried while the worker refuses it temporarily."""
        seconds = self._plan.reconnect
        return await outlast(partial(self._sent, request), seconds=seconds, passes=is_passing)

    async def _sent(self, request: PendingRequest[A]) -> A:
        """The answer to a request; reconnects if the connection is lost."""
        try:
            return await self._exchange(request)
        except LOST_ERRORS:
            if not self._may_resend(request):
                raise
            connect = partial(self._connect, self.session_id)
            await reconnect(self._close_socket, connect, seconds=self._plan.reconnect)
            self._check_not_applied(request)
            return await self._exchange(request)

    async def _exchange(self, request: PendingRequest[A]) -> A:
        socket = self._open_socket()
        seconds = self._timeout_of(request)
        with lost_connection(self._target, request.awaited):
            await socket.send(request.encoded(self._slot_for(request)))
            while True:
                try:
                    data = await receive(socket, seconds)
                except TimeoutError:
                    raise self._reply_timeout(request) from None
                if (answer := self._protocol.read(data, request)) is not None:
                    return answer

    async def _connect_first(self, session_id: str) -> None:
        """Connect, and retry if the connection is lost during the handshake."""
        connect = partial(self._connect, session_id)
        try:
            await connect()
        except LOST_ERRORS:
            if self._plan.reconnect <= 0:
                raise
            await reconnect(self._close_socket, connect, seconds=self._plan.reconnect)

    async def _connect(self, session_id: str) -> None:
        with handshake_errors(self._target):
            connection = connect_socket(**socket_options(self._target, session_id))
            self._socket = await self._socket_stack.enter_async_context(connection)
        check_subprotocol(self._socket.subprotocol)
        self._use_memory(None)
        self._welcome = await self._exchange(self._hello())
        await self._attach()

    async def _attach(self) -> None:
        """Open the shared memory offered by the welcome, and confirm it with its secret."""
        memory = self._offered_memory()
        if memory is None:
            return
        try:
            await self._exchange(self._protocol.attach(memory.secret))
        except StatusError as error:
            self._without_memory(str(error))
        else:
            self._use_memory(memory)

    def _open_socket(self) -> AsyncSocket:
        if self._socket is None:
            raise not_open()
        return self._socket

    async def _close_socket(self) -> None:
        with contextlib.suppress(OSError, websockets.exceptions.WebSocketException):
            await self._socket_stack.aclose()

    async def _release(self) -> None:
        """Close the socket, and end the session over REST if the socket could not end it."""
        await self._close_socket()
        self._socket = self._memory = None
        if self._info is not None and self._result is None:
            token = self._target.token or self._info.token
            with contextlib.suppress(Real2SimError):
                await self._transport.send(_requests.delete_session(self._info.session_id, token))
        self._info = None
