"""Real2Sim: drive a policy through a reconstructed street over the network.

::

    import real2sim
    from real2sim.planners import FollowRoute

    with real2sim.connect("http://127.0.0.1:8600") as client:
        with client.session(scene="street") as session:
            planner = FollowRoute(speed=8.0)
            obs = session.reset(seed=0, sensors=["front"], privileged=True)
            planner.reset(obs)
            while not obs.over:
                obs = session.step(planner.plan(obs))
            print(obs.reason, obs.metrics, obs.image("front").shape)

Frames, units and image layouts: ``real2sim_proto.CONVENTIONS``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from real2sim_proto.episode import SensorSpec
    from real2sim_proto.plans import Control, PoseCommand, TrajectoryPlan
    from real2sim_proto.sensors import LidarSpec, RadarSpec

    from ._async.client import AsyncClient, connect_async
    from ._async.sessions import AsyncDriveSession
    from ._sync.client import Client, connect
    from ._sync.jobs import Job, Jobs, Sweeps
    from ._sync.scenarios import Scenario, Scenarios, SceneObject
    from ._sync.scenes import Assets, Scenes
    from ._sync.sessions import DriveSession, Sessions
    from .clouds import LidarCloud, PointCloud, RadarCloud
    from .env import DriveEnv
    from .errors import (
        BadStepError,
        CapacityError,
        ConflictError,
        ConnectionLostError,
        ControllerTakenError,
        EpisodeOverError,
        GatewayError,
        ImageDecodeError,
        InvalidActionError,
        InvalidOperationError,
        InvalidRequestError,
        MalformedReplyError,
        NotFoundError,
        NotOpenError,
        NotResetError,
        ProtocolMismatchError,
        Real2SimError,
        ReplyTimeoutError,
        SessionClosedError,
        SessionElsewhereError,
        StaleRevisionError,
        StaleStepError,
        StatusError,
        StepConflictError,
        UnauthorizedError,
        UnreachableError,
        WorkerFailedError,
    )
    from .images import Frame, Image
    from .observation import Observation, View
    from .version import VERSION as __version__

__all__ = [
    "Assets",
    "AsyncClient",
    "AsyncDriveSession",
    "BadStepError",
    "CapacityError",
    "Client",
    "ConflictError",
    "ConnectionLostError",
    "Control",
    "ControllerTakenError",
    "DriveSession",
    "EpisodeOverError",
    "Frame",
    "GatewayError",
    "Image",
    "ImageDecodeError",
    "InvalidActionError",
    "InvalidOperationError",
    "InvalidRequestError",
    "Job",
    "Jobs",
    "LidarCloud",
    "LidarSpec",
    "MalformedReplyError",
    "NotFoundError",
    "NotOpenError",
    "NotResetError",
    "Observation",
    "PointCloud",
    "PoseCommand",
    "ProtocolMismatchError",
    "RadarCloud",
    "RadarSpec",
    "Real2SimError",
    "ReplyTimeoutError",
    "Scenario",
    "Scenarios",
    "SceneObject",
    "Scenes",
    "SensorSpec",
    "SessionClosedError",
    "SessionElsewhereError",
    "Sessions",
    "StaleRevisionError",
    "StaleStepError",
    "StatusError",
    "StepConflictError",
    "Sweeps",
    "TrajectoryPlan",
    "UnauthorizedError",
    "UnreachableError",
    "View",
    "WorkerFailedError",
    "__version__",
    "connect",
    "connect_async",
    "make_env",
]

_ELSEWHERE = {
    "Assets": "real2sim._sync.scenes",
    "AsyncClient": "real2sim._async.client",
    "AsyncDriveSession": "real2sim._async.sessions",
    "Client": "real2sim._sync.client",
    "Control": "real2sim_proto.plans",
    "DriveSession": "real2sim._sync.sessions",
    "Frame": "real2sim.images",
    "Image": "real2sim.images",
    "Job": "real2sim._sync.jobs",
    "Jobs": "real2sim._sync.jobs",
    "LidarCloud": "real2sim.clouds",
    "LidarSpec": "real2sim_proto.sensors",
    "Observation": "real2sim.observation",
    "PointCloud": "real2sim.clouds",
    "PoseCommand": "real2sim_proto.plans",
    "RadarCloud": "real2sim.clouds",
    "RadarSpec": "real2sim_proto.sensors",
    "Scenario": "real2sim._sync.scenarios",
    "Scenarios": "real2sim._sync.scenarios",
    "SceneObject": "real2sim._sync.scenarios",
    "Scenes": "real2sim._sync.scenes",
    "SensorSpec": "real2sim_proto.episode",
    "Sessions": "real2sim._sync.sessions",
    "Sweeps": "real2sim._sync.jobs",
    "TrajectoryPlan": "real2sim_proto.plans",
    "View": "real2sim.observation",
    "connect": "real2sim._sync.client",
    "connect_async": "real2sim._async.client",
}

_INSTEAD = {
    "Env": "real2sim.make_env(scene='street')",
    "Scene": "real2sim.connect().scenes.get('street')",
    "Session": "real2sim.connect().session(scene='street'), which is a DriveSession",
    "Simulator": "real2sim.connect()",
    "World": "real2sim.connect().session(scene='street')",
    "make": "real2sim.make_env(scene='street')",
    "planners": "import real2sim.planners",
    "render": "real2sim.connect().scenes.render('street', camera='front')",
}


def make_env(**options: Any) -> DriveEnv:
    """A session as a ``gymnasium.Env``; see :class:`real2sim.env.DriveEnv` for the options.

    Raises:
        ImportError: gymnasium is missing.

    Examples:
        >>> env = real2sim.make_env(scene="street")
        >>> obs, info = env.reset(seed=0)
        >>> obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> env.close()
    """
    try:
        from .env import DriveEnv
    except ImportError as error:
        raise ImportError("make_env needs gymnasium: pip install 'real2sim[gym]'") from error
    return DriveEnv(**options)


def __getattr__(name: str) -> Any:
    # Names are imported on first use, which keeps ``import real2sim`` fast.
    if name not in __all__:
        said = ""
        if not name.startswith("_"):
            from real2sim_proto.base import advice

            said = f"; {advice(name, __all__, _INSTEAD)}"
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{said}")
    if name == "__version__":
        value: Any = importlib.import_module("real2sim.version").VERSION
    else:
        value = getattr(importlib.import_module(_ELSEWHERE.get(name, "real2sim.errors")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
