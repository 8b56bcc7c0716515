"""Connecting to a worker."""

from __future__ import annotations

import time
from types import TracebackType
from typing import TYPE_CHECKING, ClassVar, Self

from real2sim_proto import PROTOCOL_VERSION
from real2sim_proto.scenes import Fleet, Readiness, ServerInfo

from .. import _requests
from .._handles import Handle, ScenarioRef, SceneRef, optional_scenario_id, optional_scene_name
from .._http import Target, resolve_target
from .._session_state import SessionPlan
from ..errors import CapacityError, ProtocolMismatchError, ReplyTimeoutError, UnreachableError
from .concurrency import sleep
from .jobs import AsyncJobs, AsyncSweeps
from .scenarios import AsyncScenarios
from .scenes import AsyncAssets, AsyncScenes
from .sessions import AsyncDriveSession, AsyncSessions
from .transport import AsyncTransport

if TYPE_CHECKING:
    import httpx2

POLL_SECONDS = 0.25


class AsyncClient(Handle):
    """A worker's scenes, scenarios and sessions; :func:`connect_async` is the same.

    Nothing is sent yet. Arguments take precedence over the environment, and the environment over
    the defaults.

    Args:
        url: ``http://host:port`` or ``https://...``; default: ``$REAL2SIM_URL``, else
            ``http://127.0.0.1:8600``.
        token: bearer token of the worker; default: ``$REAL2SIM_TOKEN``, else none. ``""`` sends
            none whatever the environment says.
        name: who is calling; the history of scenarios names it.
        timeout: seconds that a reply may take; calls that may load a scene or
            compile kernels have at least 300.
        retries: more tries of requests that may safely be sent again.
        shared_memory: of sessions that do not say so themselves, see :meth:`AsyncClient.session`.
        transport: replaces the network, for tests of programs that use the SDK.

    Attributes:
        scenes: :class:`AsyncScenes`.
        scenarios: :class:`AsyncScenarios`.
        assets: :class:`AsyncAssets`.
        jobs: :class:`AsyncJobs`.
        sessions: :class:`AsyncSessions`.
        sweeps: :class:`AsyncSweeps`.

    Raises:
        ValueError: not such an address.

    Examples:
        >>> client = real2sim.connect_async(timeout=10.0, name="anna")
        >>> [scene.scene for scene in await client.scenes.list()]
        ['street']

        Used as ``async with real2sim.connect_async() as client:`` it closes by itself.
    """

    _instead: ClassVar = {
        "cameras": "client.scenes.get('street').cameras",
        "create_session": "client.session(scene='street')",
        "drive": "client.session(scene='street')",
        "get_scenes": "client.scenes.list()",
        "get_server_version": "client.server().version",
        "get_world": "client.session(scene='street')",
        "list_scenes": "client.scenes.list()",
        "load": "client.scenes.load('street')",
        "load_scene": "client.scenes.load('street')",
        "load_world": "client.scenes.load('street')",
        "ping": "client.readiness()",
        "render": "client.scenes.render('street', camera='front')",
        "reset": "client.session(scene='street').open().reset()",
        "scenario": "client.scenarios.create(scene='street')",
        "scene": "client.scenes.get('street')",
        "status": "client.readiness()",
        "step": "client.session(scene='street'), which has reset() and step(plan)",
        "version": "client.server().version",
    }

    def __init__(
        self,
        url: str | None = None,
        *,
        token: str | None = None,
        name: str | None = None,
        timeout: float = 30.0,
        retries: int = 2,
        shared_memory: bool | None = None,
        transport: httpx2.AsyncBaseTransport | None = None,
    ) -> None:
        target = resolve_target(
            url, token, timeout=timeout, name=name, retries=retries, shared_memory=shared_memory
        )
        self._transport = link = AsyncTransport(target, transport=transport)
        self.scenes = AsyncScenes(link)
        self.scenarios = AsyncScenarios(link)
        self.assets = AsyncAssets(link)
        self.jobs = AsyncJobs(link)
        self.sessions = AsyncSessions(link)
        self.sweeps = AsyncSweeps(link)

    async def server(self) -> ServerInfo:
        """Versions, device, limits, conventions.

        Raises:
            UnreachableError: no worker answers.
            ProtocolMismatchError: the worker speaks another protocol version.

        Examples:
            >>> info = await client.server()
            >>> info.device.backend, info.conventions["quaternion"]
            ('cpu', 'wxyz, unit length')
        """
        return _same_protocol(await self._transport.send(_requests.server_info()))

    async def fleet(self) -> Fleet:
        """The workers that share the worker's store, with what each last told of itself.

        Examples:
            >>> [(w.worker_id, w.alive) for w in (await client.fleet()).workers]
            [('w0', True)]
        """
        return await self._transport.send(_requests.fleet())

    async def readiness(self) -> Readiness:
        """Whether the worker takes new sessions now, and if not, why.

        Examples:
            >>> (await client.readiness()).ready
            True
        """
        return await self._transport.send(_requests.readiness())

    async def wait_ready(self, timeout: float = 120.0) -> ServerInfo:
        """Wait until the worker is ready; it may still be starting.

        Raises:
            ReplyTimeoutError: it did not become ready; the hint says what was in the way.

        Examples:
            >>> info = await client.wait_ready(timeout=60.0)
        """
        deadline = time.monotonic() + timeout
        while (obstacle := await self._obstacle()) is not None:
            if time.monotonic() > deadline:
                raise _not_ready(self._transport.target, timeout, obstacle)
            await sleep(POLL_SECONDS)
        return await self.server()

    def session(
        self,
        scene: SceneRef | None = None,
        *,
        scenario: ScenarioRef | None = None,
        codec: str = "auto",
        reconnect: float = 60.0,
        shared_memory: bool | None = None,
    ) -> AsyncDriveSession:
        """A new session on a scene or a scenario, to be opened by ``async with``.

        Args:
            scene: a scene or its name; or
            scenario: a scenario or its id.
            codec: of cameras that name none: ``auto`` (raw when the worker is on this machine,
                else jpeg), ``raw``, ``jpeg`` or ``png``.
            reconnect: seconds for which a lost connection is tried again, and for which a message
                is sent again that the worker refuses for now, because its store is away or a limit
                of the token is reached. The session goes on as if nothing had happened, also after
                the worker was restarted. 0 gives up.
            shared_memory: raw images come by memory shared with a worker on this machine: None,
                where both can; True, or opening the session fails; False, never. The images are
                the same, and are good for as long as anybody holds them.

        Raises:
            TypeError: something else than a scene or a scenario.

        Examples:
            >>> scenario = await client.scenarios.create(scene="street", name="no red car")
            >>> deleted = await scenario.objects["car_red"].delete()
            >>> async with client.session(scenario=scenario) as session:
            ...     obs = await session.reset(privileged=True)
            >>> sorted(agent.object_id for agent in obs.agents)
            ['car_blue', 'post']
        """
        plan = SessionPlan(
            scene=optional_scene_name(scene),
            scenario=optional_scenario_id(scenario),
            codec=codec,
            reconnect=reconnect,
            shared_memory=shared_memory,
        )
        return AsyncDriveSession(self._transport, plan)

    def join(
        self,
        session_id: str,
        *,
        token: str,
        role: str = "controller",
        codec: str = "auto",
        shared_memory: bool | None = None,
    ) -> AsyncDriveSession:
        """A session that exists already; closing leaves it running.

        Args:
            session_id: of that session.
            token: of that session.
            role: ``controller`` or ``observer``, which sees what the controller sees.
            codec, shared_memory: as of :meth:`session`.

        Examples:
            >>> async with client.session(scene="street") as session:
            ...     token = session.token
            ...     async with client.join(session.session_id, token=token, role="observer") as o:
            ...         print(o.welcome.role)
            observer
        """
        plan = SessionPlan(
            session_id=session_id, token=token, role=role, codec=codec, shared_memory=shared_memory
        )
        return AsyncDriveSession(self._transport, plan)

    async def close(self) -> None:
        """Close the connections.

        Examples:
            >>> await client.close()
        """
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
        return f"{type(self).__name__}({self._transport.target})"

    async def _obstacle(self) -> str | None:
        try:
            return _obstacle_in(await self.readiness())
        except (UnreachableError, ReplyTimeoutError, CapacityError) as error:
            return str(error)


connect_async = AsyncClient


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
