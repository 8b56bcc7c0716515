"""Connecting to a worker."""

from __future__ import annotations

import asyncio
import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

from real2sim_proto import PROTOCOL_VERSION
from real2sim_proto.scenes import Readiness, ServerInfo

from . import _requests
from ._assets import Assets, AsyncAssets
from ._jobs import AsyncJobs, Jobs
from ._retry import RetryPolicy
from ._scenarios import Scenarios
from ._scenarios_async import AsyncScenarios
from ._scenes import AsyncScenes, Scenes
from ._sessions import AsyncSessions, Sessions
from ._transport import AsyncTransport, Target, Transport
from .drive_session import DriveSession, SessionPlan
from .drive_session_async import AsyncDriveSession
from .errors import ProtocolMismatchError, ReplyTimeoutError, UnreachableError

if TYPE_CHECKING:
    import httpx2

DEFAULT_URL = "http://127.0.0.1:8600"
POLL_SECONDS = 0.25


def connect(
    url: str = DEFAULT_URL,
    *,
    token: str | None = None,
    name: str | None = None,
    timeout: float = 30.0,
    retries: int = 2,
    transport: httpx2.BaseTransport | None = None,
) -> Client:
    """A client of the worker at ``url``. Nothing is sent yet.

    Args:
        url: ``http://host:port`` or ``https://...``.
        token: bearer token of the worker.
        name: who is calling; the history of scenarios names it.
        timeout: seconds that a reply may take; calls that may load a scene or
            compile kernels have at least 300.
        retries: more tries of requests that may safely be sent again.
        transport: replaces the network, for tests of programs that use the SDK.

    Raises:
        ValueError: not such an address.
    """
    target = Target(url, token, timeout, name=name, policy=RetryPolicy(retries))
    return Client(Transport(target, transport=transport))


def connect_async(
    url: str = DEFAULT_URL,
    *,
    token: str | None = None,
    name: str | None = None,
    timeout: float = 30.0,
    retries: int = 2,
    transport: httpx2.AsyncBaseTransport | None = None,
) -> AsyncClient:
    """Async twin of :func:`connect`."""
    target = Target(url, token, timeout, name=name, policy=RetryPolicy(retries))
    return AsyncClient(AsyncTransport(target, transport=transport))


class Client:
    """A worker's scenes, scenarios and sessions; made by :func:`connect`."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self.scenes = Scenes(transport)
        self.scenarios = Scenarios(transport)
        self.assets = Assets(transport)
        self.jobs = Jobs(transport)
        self.sessions = Sessions(transport)

    def server(self) -> ServerInfo:
        """Versions, device, limits, conventions.

        Raises:
            ProtocolMismatchError: the worker speaks another protocol version.
        """
        return _same_protocol(self._transport.send(_requests.server_info()))

    def readiness(self) -> Readiness:
        """Whether the worker takes new sessions now, and if not, why."""
        return self._transport.send(_requests.readiness())

    def wait_ready(self, timeout: float = 120.0) -> ServerInfo:
        """Wait until the worker is ready; it may still be starting.

        Raises:
            ReplyTimeoutError: it did not become ready; the hint says what was in the way.
        """
        deadline = time.monotonic() + timeout
        while (obstacle := self._obstacle()) is not None:
            if time.monotonic() > deadline:
                raise _not_ready(self._transport.target, timeout, obstacle)
            time.sleep(POLL_SECONDS)
        return self.server()

    def session(
        self,
        *,
        scene: str | None = None,
        scenario: str | None = None,
        codec: str = "auto",
        reconnect: float = 60.0,
    ) -> DriveSession:
        """A new session on a scene or a scenario, to be opened by ``with``.

        Args:
            scene: name of a scene; or
            scenario: id of a scenario.
            codec: of cameras that name none: ``auto`` (raw when the worker is on this machine,
                else jpeg), ``raw``, ``jpeg`` or ``png``.
            reconnect: seconds for which a lost connection is tried again: the session goes on as
                if nothing had happened, also after the worker was started anew. 0 gives up.
        """
        plan = SessionPlan(scene=scene, scenario=scenario, codec=codec, reconnect=reconnect)
        return DriveSession(self._transport, plan)

    def join(
        self, session_id: str, *, token: str, role: str = "controller", codec: str = "auto"
    ) -> DriveSession:
        """A session that exists already; closing leaves it running."""
        plan = SessionPlan(session_id=session_id, token=token, role=role, codec=codec)
        return DriveSession(self._transport, plan)

    def close(self) -> None:
        """Close the connections."""
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Client({self._transport.target})"

    def _obstacle(self) -> str | None:
        try:
            return _obstacle_in(self.readiness())
        except (UnreachableError, ReplyTimeoutError) as error:
            return str(error)


class AsyncClient:
    """Async twin of :class:`Client`; made by :func:`connect_async`."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport
        self.scenes = AsyncScenes(transport)
        self.scenarios = AsyncScenarios(transport)
        self.assets = AsyncAssets(transport)
        self.jobs = AsyncJobs(transport)
        self.sessions = AsyncSessions(transport)

    async def server(self) -> ServerInfo:
        """Versions, device, limits, conventions; see :meth:`Client.server`."""
        return _same_protocol(await self._transport.send(_requests.server_info()))

    async def readiness(self) -> Readiness:
        """Whether the worker takes new sessions now, and if not, why."""
        return await self._transport.send(_requests.readiness())

    async def wait_ready(self, timeout: float = 120.0) -> ServerInfo:
        """Wait until the worker is ready; see :meth:`Client.wait_ready`."""
        deadline = time.monotonic() + timeout
        while (obstacle := await self._obstacle()) is not None:
            if time.monotonic() > deadline:
                raise _not_ready(self._transport.target, timeout, obstacle)
            await asyncio.sleep(POLL_SECONDS)
        return await self.server()

    def session(
        self,
        *,
        scene: str | None = None,
        scenario: str | None = None,
        codec: str = "auto",
        reconnect: float = 60.0,
    ) -> AsyncDriveSession:
        """A new session, to be opened by ``async with``; see :meth:`Client.session`."""
        plan = SessionPlan(scene=scene, scenario=scenario, codec=codec, reconnect=reconnect)
        return AsyncDriveSession(self._transport, plan)

    def join(
        self, session_id: str, *, token: str, role: str = "controller", codec: str = "auto"
    ) -> AsyncDriveSession:
        """A session that exists already; closing leaves it running."""
        plan = SessionPlan(session_id=session_id, token=token, role=role, codec=codec)
        return AsyncDriveSession(self._transport, plan)

    async def close(self) -> None:
        """Close the connections."""
        await self._transport.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()

    def __repr__(self) -> str:
        return f"AsyncClient({self._transport.target})"

    async def _obstacle(self) -> str | None:
        try:
            return _obstacle_in(await self.readiness())
        except (UnreachableError, ReplyTimeoutError) as error:
            return str(error)


def _same_protocol(info: ServerInfo) -> ServerInfo:
    if info.protocol_version != PROTOCOL_VERSION:
        raise ProtocolMismatchError(
            f"the worker (version {info.version}) speaks protocol {info.protocol_version}; this "
            f"client speaks {PROTOCOL_VERSION}",
            hint="install a client and a worker of the same major version",
        )
    return info


def _obstacle_in(readiness: Readiness) -> str | None:
    if readiness.ready:
        return None
    return "; ".join(readiness.reasons) or "the worker gives no reason"


def _not_ready(target: Target, seconds: float, obstacle: str) -> ReplyTimeoutError:
    return ReplyTimeoutError(f"ready worker at {target.url}", seconds, hint=obstacle)
