"""Driving many sessions at once: one message steps all of their worlds."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from functools import partial
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import websockets

from real2sim_proto.drive import Envelope
from real2sim_proto.drive_batch import BatchMember, BatchObs, BatchResult, BatchWelcome, Plans
from real2sim_proto.sessions import SessionInfo

from .. import _requests
from .._batch_protocol import BatchProtocol
from .._drive_socket import check_subprotocol, handshake_errors, lost_connection, socket_options
from .._protocol import PendingRequest, error_of
from .._sensors import ResetOptions, Sensor, reset_spec
from .._session_state import LOST_ERRORS, SessionPlan, is_passing, not_open
from ..batch_observation import BatchObservation, batch_observation_from_wire
from ..errors import Real2SimError, ReplyTimeoutError
from .concurrency import AsyncSocket, connect_socket, receive
from .reconnecting import outlast, reconnect
from .transport import AsyncTransport

A = TypeVar("A", bound=Envelope)

BATCH = "batch"
"""Stands in the address where sessions have their id."""


class AsyncDriveBatch:
    """Many sessions of one scene in lock step; made by :meth:`AsyncClient.batch`.

    Worlds are numbered from 0. Each does what a session of its own would do, bit for bit; what is
    wrong with one is in ``errors`` of the observation, and the others go on. Episodes of a batch
    have no deadlines.

    Examples:
        >>> client = real2sim.connect_async()
        >>> batch = await client.batch(scene="street", worlds=3).open()
        >>> obs = await batch.reset(seeds=[1, 2, 3], action="control")
        >>> obs.step.tolist(), obs.ego.shape
        ([0, 0, 0], (3, 13))

        Used as ``async with client.batch(scene="street", worlds=3) as batch:`` it closes by itself.
    """

    def __init__(self, transport: AsyncTransport, plan: SessionPlan, worlds: int) -> None:
        self._transport = transport
        self._target = transport.target
        self._plan = plan
        self._worlds = worlds
        self._protocol = BatchProtocol(worlds)
        self._infos: list[SessionInfo] = []
        self._members: list[BatchMember] = []
        self._welcome: BatchWelcome | None = None
        self._result: BatchResult | None = None
        self._socket: AsyncSocket | None = None
        self._socket_stack = contextlib.AsyncExitStack()

    def __repr__(self) -> str:
        return f"{type(self).__name__}(worlds={self._worlds})"

    async def open(self) -> Self:
        """Create the sessions and shake hands.

        Raises:
            UnreachableError: no worker answers.
            NotFoundError: no such scene or scenario.
            CapacityError: the worker has not so many sessions free.

        Examples:
            >>> other = await client.batch(scene="street", worlds=2).open()
            >>> len(other.session_ids)
            2
            >>> result = await other.close()
        """
        try:
            for _ in range(self._worlds):
                call = _requests.create_session(self._plan.scene, self._plan.scenario, None)
                self._infos.append(await self._transport.send(call))
            self._members = [
                BatchMember(session_id=i.session_id, token=i.token) for i in self._infos
            ]
            await self._connect()
        except BaseException:
            await self._release()
            raise
        return self

    @property
    def welcome(self) -> BatchWelcome:
        """What the worker said at the start: worlds, limits, versions.

        Raises:
            NotOpenError: the batch was not opened yet.
        """
        if self._welcome is None:
            raise not_open()
        return self._welcome

    @property
    def session_ids(self) -> list[str]:
        """Id of each world's session, for the calls of :class:`AsyncSessions`."""
        return [world.session_id for world in self.welcome.worlds]

    async def reset(
        self,
        *,
        sensors: Sequence[Sensor] = (),
        worlds: Sequence[int] | None = None,
        seeds: Sequence[int] | None = None,
        starts_us: Sequence[int] | None = None,
        **options: Unpack[ResetOptions],
    ) -> BatchObservation:
        """Start episodes and return their first instants.

        Args:
            sensors: as of :meth:`AsyncDriveSession.reset`; all images come in one message.
            worlds: numbers of those that begin anew; default: all.
            seeds: one for each of them, in place of ``seed``.
            starts_us: one for each of them, in place of ``start_us`` [us].
            options: as of :meth:`AsyncDriveSession.reset`; no deadlines.

        Raises:
            ValueError: an option that is not allowed.
            InvalidRequestError: an episode that batches do not have.
            StatusError: no world could begin; the error of the first.

        Examples:
            >>> obs = await batch.reset(worlds=[2], seeds=[9], action="control", horizon=9)
            >>> obs.worlds.tolist()
            [2]
        """
        spec = reset_spec(sensors, self._target.codec(self._plan.codec), options)
        request = self._protocol.reset(spec, worlds, seeds, starts_us)
        return _observed(await self._request(request))

    async def step(
        self, plans: Plans | Mapping[str, Any], *, worlds: Sequence[int] | None = None
    ) -> BatchObservation:
        """Send a plan for the newest instant of each world; returns the next ones.

        A world that refuses its plan is in ``errors`` of what is returned, has no row in it, and
        stays where it is.

        Args:
            plans: of kind ``control`` (``values`` [M, 2]: acceleration [m/s^2], road-wheel angle
                [rad]), ``trajectory`` (``times_us`` [M, K], ``poses`` [M, K, 3]) or ``pose``
                (``values`` [M, 3]).
            worlds: numbers of those that move, M of them; default: all.

        Raises:
            NotResetError: no episode runs in one of them.
            ValueError: plans that are not valid.
            StatusError: no world could move; the error of the first.

        Examples:
            >>> obs = await batch.step({"kind": "control", "values": np.tile([0.5, 0.0], (3, 1))})
            >>> obs.step.tolist(), obs.errors
            ([1, 1, 1], [])
        """
        request = self._protocol.action(plans, worlds)
        return _observed(await self._request(request))

    async def close(self) -> BatchResult | None:
        """End all sessions; idempotent.

        Returns:
            Final scores of each world, where the worker could still give them.

        Examples:
            >>> result = await batch.close()
            >>> [world.steps for world in result.results]
            [0, 0, 0]
        """
        if self._socket is not None:
            # A worker that is no longer there must not hold up who wants to leave.
            with contextlib.suppress(Real2SimError):
                self._result = await self._exchange(self._protocol.bye())
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

    async def _request(self, request: PendingRequest[A]) -> A:
        """The answer to a request, once the worker takes it."""
        seconds = self._plan.reconnect
        return await outlast(partial(self._sent, request), seconds=seconds, passes=is_passing)

    async def _sent(self, request: PendingRequest[A]) -> A:
        """The answer to a request, over a new connection where the old one is lost: worlds that
        have moved already answer a repeated action once more."""
        try:
            return await self._exchange(request)
        except LOST_ERRORS:
            if self._plan.reconnect <= 0:
                raise
            await reconnect(self._close_socket, self._connect, seconds=self._plan.reconnect)
            return await self._exchange(request)

    async def _exchange(self, request: PendingRequest[A]) -> A:
        if self._socket is None:
            raise not_open()
        seconds = self._target.long_timeout if request.long_timeout else self._target.timeout
        with lost_connection(self._target, request.awaited):
            await self._socket.send(request.encoded())
            while True:
                try:
                    data = await receive(self._socket, seconds)
                except TimeoutError:
                    raise ReplyTimeoutError(
                        f"{request.awaited} from {self._target.url}", seconds
                    ) from None
                if (answer := self._protocol.read(data, request)) is not None:
                    return answer

    async def _connect(self) -> None:
        with handshake_errors(self._target):
            connection = connect_socket(**socket_options(self._target, BATCH))
            self._socket = await self._socket_stack.enter_async_context(connection)
        check_subprotocol(self._socket.subprotocol)
        self._welcome = await self._exchange(self._protocol.hello(self._members))
        self._members = [
            member.model_copy(update={"resume_token": world.resume_token})
            for member, world in zip(self._members, self._welcome.worlds, strict=True)
        ]

    async def _close_socket(self) -> None:
        with contextlib.suppress(OSError, websockets.exceptions.WebSocketException):
            await self._socket_stack.aclose()

    async def _release(self) -> None:
        """Close the socket, and end sessions that have not been ended over it."""
        await self._close_socket()
        self._socket = None
        if self._result is None:
            for info in self._infos:
                token = self._target.token or info.token
                with contextlib.suppress(Real2SimError):
                    await self._transport.send(_requests.delete_session(info.session_id, token))
        self._infos = []


def _observed(obs: BatchObs) -> BatchObservation:
    """What is seen; where no world could do what was asked for, the error of the first."""
    if obs.errors and not len(obs.worlds):
        raise error_of(obs.errors[0])
    return batch_observation_from_wire(obs)
