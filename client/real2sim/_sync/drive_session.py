# Made from _async/drive_session.py by scripts/unasync.py; edit that file, then run the script.
"""Driving a session over its socket, in lock step: one plan, one observation.

A session is used by one thread or task at a time.
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
from real2sim_proto.operations import Operation
from real2sim_proto.plans import Plan

from .. import _requests
from .._drive_socket import check_subprotocol, handshake_errors, lost_connection, socket_options
from .._protocol import PendingRequest
from .._sensors import (
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
    is_away,
    is_passing,
    not_open,
)
from ..errors import Real2SimError, ReplyTimeoutError, StatusError
from ..images import write_atomically
from ..observation import Observation, View, observation_from_wire, view_from_frames
from .concurrency import Socket, connect_socket, receive, run_blocking
from .reconnecting import outlast, reconnect
from .transport import Transport

A = TypeVar("A", bound=Envelope)


class DriveSession(SessionBase):
    """A session in lock step; made by :meth:`Client.session`.

    Examples:
        >>> client = real2sim.connect()
        >>> session = client.session(scene="street").open()
        >>> obs = session.reset(seed=0, sensors=["front"])
        >>> obs.step, obs.image("front").shape
        (0, (64, 96, 3))

        Used as ``with client.session(scene="street") as session:`` it closes by itself.
    """

    def __init__(self, transport: Transport, plan: SessionPlan) -> None:
        super().__init__(transport.target, plan)
        self._transport = transport
        self._socket: Socket | None = None
        self._socket_stack = contextlib.ExitStack()

    def open(self) -> Self:
        """Create or join the session and shake hands; loading is over when this returns.

        Raises:
            UnreachableError: no worker answers.
            NotFoundError: no such scene, scenario or session.
            CapacityError: the worker is full.

        Examples:
            >>> other = client.session(scene="street").open()
            >>> other.cameras
            ['front', 'left']
            >>> result = other.close()
        """
        session_id = self._plan.session_id
        if session_id is None:
            call = _requests.create_session(self._plan.scene, self._plan.scenario, None)
            create = partial(self._transport.send, call)
            self._info = outlast(create, seconds=self._plan.reconnect, passes=is_away)
            session_id, self._token = self._info.session_id, self._info.token
        try:
            self._connect_first(session_id)
        except BaseException:
            self._release()
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
                ``real2sim_proto.episode.ResetSpec``. ``lidars`` and ``radars`` are names of the
                worker's catalogues, or specs.

        Raises:
            ValueError: an option that is not allowed.

        Examples:
            >>> obs = session.reset(
            ...     seed=7,
            ...     sensors=[{"camera": "front", "modalities": ["rgb", "depth"], "width": 48}],
            ...     action="control",
            ...     privileged=True,
            ... )
            >>> obs.image("front", "depth").shape
            (32, 48)
            >>> sorted(agent.object_id for agent in obs.agents)
            ['car_blue', 'car_red', 'post']
            >>> obs = session.reset(lidars=["vlp-16"], radars=["corner"])
            >>> sweep, scan = obs.lidar("vlp-16"), obs.radar("corner")
            >>> sweep.points.shape[1], sweep.t_us, scan.modality
            (3, 0, 'radar')
        """
        spec = reset_spec(sensors, self._codec, options)
        return self._observe(self._protocol.reset(spec))

    def step(self, plan: Plan | Mapping[str, Any]) -> Observation:
        """Send the plan for the newest observation; returns the next one.

        After a ReplyTimeoutError the same plan may be sent again: the worker moves only once. A
        plan that misses the episode's deadline is not applied; the observation that the worker
        went on to is returned, with a ``deadline_missed`` event.

        Raises:
            NotResetError: no episode runs.
            InvalidActionError: a plan of another kind than ``reset(action=...)`` said.
            EpisodeOverError: the episode has ended.

        Examples:
            >>> ahead = [obs.t_us + 500_000, obs.t_us + 1_000_000]
            >>> plan = real2sim.TrajectoryPlan(times_us=ahead, poses=[(2.5, 0, 0), (5, 0, 0)])
            >>> obs = session.step(plan)
            >>> obs.step, obs.t_us
            (1, 100000)
        """
        return self._observe(self._protocol.action(plan))

    def receive(self, timeout: float | None = None) -> Observation:
        """The next unsolicited observation: what an observer sees of the controller's loop.

        Args:
            timeout: seconds to wait; default: the client's.

        Raises:
            ReplyTimeoutError: none came in time.

        Examples:
            >>> spectator = client.join(session.session_id, token=session.token, role="observer")
            >>> spectator = spectator.open()
            >>> plan = {"kind": "trajectory", "times_us": [1_000_000], "poses": [(5, 0, 0)]}
            >>> obs = session.step(plan)
            >>> (spectator.receive(timeout=10.0)).step
            1
            >>> spectator.close()
        """
        seconds = self._target.timeout if timeout is None else timeout
        until = time.monotonic() + seconds
        while (message := self._protocol.take_unsolicited()) is None:
            with lost_connection(self._target, "an observation"):
                try:
                    data = receive(self._open_socket(), max(until - time.monotonic(), 0.0))
                except TimeoutError:
                    raise ReplyTimeoutError("observation", seconds) from None
            self._protocol.handle_unsolicited(data)
        return observation_from_wire(message)

    def edit(self, operations: Sequence[Operation | Mapping[str, Any]]) -> Edited:
        """Change this session's world before the next step; all operations apply, or none.

        Raises:
            ValueError: an operation that is not valid.
            InvalidOperationError: an unknown object, or a result that is not allowed.

        Examples:
            >>> edited = session.edit([{"op": "duplicate", "object_id": "car_red", "x": 9.0}])
            >>> edited.created
            ['car_red_copy1']
        """
        return self._request(self._protocol.edit(operations))

    def render(
        self,
        sensors: Sequence[Sensor] = (),
        *,
        lidars: Sequence[LidarSensor] = (),
        radars: Sequence[RadarSensor] = (),
    ) -> View:
        """Images of the current instant, and clouds of LiDARs and radars; never moves time.

        Examples:
            >>> view = session.render(["left"])
            >>> view.image("left").shape
            (64, 96, 3)
            >>> view = session.render(lidars=[{"lidar": "top", "model": "vlp-16"}])
            >>> view.lidar("top").frame
            'sensor'
        """
        asked = sensor_specs(sensors, self._codec), ranging_specs(lidars, radars)
        view = self._request(self._protocol.render(*asked))
        return view_from_frames(
            view.frames,
            t_us=view.t_us,
            revision=view.revision,
            timing=view.timing,
            pixels=self._pixels_of(view.frames),
            clouds=view.clouds,
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

        Examples:
            >>> drivers = {"car_blue": {"kind": "external"}}
            >>> obs = session.reset(agents={"drivers": drivers})
            >>> session.steer("car_blue", [500_000, 1_000_000], [(10, 0, 0), (12, 1, 0.3)])
            0
        """
        driven = self._request(self._protocol.agent(object_id, times_us, poses))
        return driven.step

    def snapshot(self, name: str) -> Kept:
        """Keep the present instant under a name, to return to by :meth:`restore`.

        Examples:
            >>> kept = session.snapshot("before")
            >>> kept.step
            0
        """
        return self._request(self._protocol.snapshot(name))

    def restore(self, name: str) -> Observation:
        """Go back to a snapshot; its observation.

        Examples:
            >>> kept = session.snapshot("before")
            >>> plan = {"kind": "trajectory", "times_us": [1_000_000], "poses": [(5, 0, 0)]}
            >>> obs = session.step(plan)
            >>> (session.restore("before")).step
            0
        """
        return self._observe(self._protocol.restore(name))

    def fork(self) -> Forked:
        """Another session that goes on from this instant.

        Examples:
            >>> forked = session.fork()
            >>> branch = client.join(forked.session_id, token=forked.token).open()
            >>> branch.session_id != session.session_id
            True
            >>> branch.close()
        """
        return self._request(self._protocol.fork())

    def save_recording(self, path: Path | str, *, frames: bool = False) -> Path:
        """Write the running episode to a file, to be replayed and scored again.

        Args:
            path: for example ``drive.r2e``.
            frames: whether the images of its sensors are drawn once more and kept too.

        Examples:
            >>> path = session.save_recording(folder / "drive.r2e")
            >>> path.stat().st_size > 0
            True
        """
        call = _requests.record_session(self.session_id, self._token, frames)
        run_blocking(write_atomically, Path(path), self._transport.send(call))
        return Path(path)

    def close(self) -> Result | None:
        """End a session that this handle made, or leave one that it joined; idempotent.

        Returns:
            Final scores, where the worker could still give them.

        Examples:
            >>> result = session.close()
            >>> result.steps
            0
        """
        if self._socket is not None and self._plan.session_id is None:
            # A worker that is no longer there must not hold up who wants to leave.
            with contextlib.suppress(Real2SimError):
                self._result = self._request(self._protocol.bye())
        self._release()
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

    def _observe(self, request: PendingRequest[Obs]) -> Observation:
        obs = self._request(request)
        return observation_from_wire(obs, self._pixels_of(obs.frames))

    def _request(self, request: PendingRequest[A]) -> A:
        """The answer to a request, once the worker takes it."""
        seconds = self._plan.reconnect
        return outlast(partial(self._sent, request), seconds=seconds, passes=is_passing)

    def _sent(self, request: PendingRequest[A]) -> A:
        """The answer to a request, over a new connection where the old one is lost."""
        try:
            return self._exchange(request)
        except LOST_ERRORS:
            if not self._may_resend(request):
                raise
            connect = partial(self._connect, self.session_id)
            reconnect(self._close_socket, connect, seconds=self._plan.reconnect)
            self._check_not_applied(request)
            return self._exchange(request)

    def _exchange(self, request: PendingRequest[A]) -> A:
        socket = self._open_socket()
        seconds = self._timeout_of(request)
        with lost_connection(self._target, request.awaited):
            socket.send(request.encoded(self._slot_for(request)))
            while True:
                try:
                    data = receive(socket, seconds)
                except TimeoutError:
                    raise self._reply_timeout(request) from None
                if (answer := self._protocol.read(data, request)) is not None:
                    return answer

    def _connect_first(self, session_id: str) -> None:
        """Connect; again where the connection is lost on the way, as later on."""
        connect = partial(self._connect, session_id)
        try:
            connect()
        except LOST_ERRORS:
            if self._plan.reconnect <= 0:
                raise
            reconnect(self._close_socket, connect, seconds=self._plan.reconnect)

    def _connect(self, session_id: str) -> None:
        with handshake_errors(self._target):
            connection = connect_socket(**socket_options(self._target, session_id))
            self._socket = self._socket_stack.enter_context(connection)
        check_subprotocol(self._socket.subprotocol)
        self._use_memory(None)
        self._welcome = self._exchange(self._hello())
        self._attach()

    def _attach(self) -> None:
        """Open the memory that the welcome offers, and prove it by its secret."""
        memory = self._offered_memory()
        if memory is None:
            return
        try:
            self._exchange(self._protocol.attach(memory.secret))
        except StatusError as error:
            self._without_memory(str(error))
        else:
            self._use_memory(memory)

    def _open_socket(self) -> Socket:
        if self._socket is None:
            raise not_open()
        return self._socket

    def _close_socket(self) -> None:
        with contextlib.suppress(OSError, websockets.exceptions.WebSocketException):
            self._socket_stack.close()

    def _release(self) -> None:
        """Close the socket, and end a session that has not been ended over it."""
        self._close_socket()
        self._socket = self._memory = None
        if self._info is not None and self._result is None:
            token = self._target.token or self._info.token
            with contextlib.suppress(Real2SimError):
                self._transport.send(_requests.delete_session(self._info.session_id, token))
        self._info = None
