"""The client of a worker."""

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
    """A client of one worker: scenes, scenarios and sessions; :func:`connect_async` makes one.

    The constructor sends nothing. Arguments take precedence over the environment, and the
    environment over the defaults.

    Args:
        url: ``http://host:port`` or ``https://...``; default: ``$REAL2SIM_URL``, else
            ``http://127.0.0.1:8600``.
        token: bearer token of the worker; default: ``$REAL2SIM_TOKEN``, else none. ``""`` sends
            no token, even if the environment has one.
        name: name of the caller, shown in the history of scenarios.
        timeout: maximum seconds to wait for a reply; calls that may load a scene or
            compile kernels wait at least 300.
        retries: number of retries of requests that are safe to repeat.
        shared_memory: default for sessions, see :meth:`AsyncClient.session`.
        transport: replaces the network, for tests of programs that use the SDK.

    Attributes:
        scenes: :class:`AsyncScenes`.
        scenarios: :class:`AsyncScenarios`.
        assets: :class:`AsyncAssets`.
        jobs: :class:`AsyncJobs`.
        sessions: :class:`AsyncSessions`.
        sweeps: :class:`AsyncSweeps`.

    Raises:
        ValueError: invalid address.

    Examples:
        >>> client = real2sim.connect_async(timeout=10.0, name="anna")
        >>> [scene.scene for scene in await client.scenes.list()]
        ['street']

        As a context manager, ``async with real2sim.connect_async() as client:`` closes it.
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
            UnreachableError: no worker responds.
            ProtocolMismatchError: the worker has another protocol version.

        Examples:
            >>> info = await client.server()
            >>> info.device.backend, info.conventions["quaternion"]
            ('cpu', 'wxyz, unit length')
        """
        return _same_protocol(await self._transport.send(_requests.server_info()))

    async def fleet(self) -> Fleet:
        """The workers that share the worker's store, with the last status each reported.

        Examples:
            >>> [(w.worker_id, w.alive) for w in (await client.fleet()).workers]
            [('w0', True)]
        """
        return await self._transport.send(_requests.fleet())

    async def readiness(self) -> Readiness:
        """Whether the worker accepts new sessions, and the reason if it does not.

        Examples:
            >>> (await client.readiness()).ready
            True
        """
        return await self._transport.send(_requests.readiness())

    async def wait_ready(self, timeout: float = 120.0) -> ServerInfo:
        """Wait until the worker is ready, also while it is starting.

        Raises:
            ReplyTimeoutError: it did not become ready in time; the hint gives the reason.

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
        """A new session on a scene or a scenario, to be opened with ``async with``.

        Args:
            scene: a scene or its name; or
            scenario: a scenario or its id.
            codec: codec of cameras that set none: ``auto`` (raw if the worker is on this machine,
                else jpeg), ``raw``, ``jpeg`` or ``png``.
            reconnect: seconds to retry a lost connection, or a message that the worker refuses
                temporarily (its store is unreachable, or a limit of the token is reached). The
                session then continues unchanged, even after a restart of the worker. 0 disables
                retries.
            shared_memory: transfer of raw images through memory shared with a worker on this
                machine. None uses it if both sides can; True requires it to open the session;
                False never uses it. The images are identical and stay valid while referenced.

        Raises:
            TypeError: neither a scene nor a scenario.

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
        """An existing session; closing the handle leaves it running.

        Args:
            session_id: id of the session.
            token: token of the session.
            role: ``controller``, or ``observer``, which receives the controller's observations.
            codec, shared_memory: see :meth:`session`.

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
