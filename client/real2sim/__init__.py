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
    from real2sim_proto.ranging import LidarSpec, RadarSpec

    from ._async.client import AsyncClient, connect_async
    from ._async.drive_batch import AsyncDriveBatch
    from ._async.drive_session import AsyncDriveSession
    from ._sync.client import Client, connect
    from ._sync.drive_batch import DriveBatch
    from ._sync.drive_session import DriveSession
    from .batch_observation import BatchImages, BatchObservation
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
    "AsyncClient",
    "AsyncDriveBatch",
    "AsyncDriveSession",
    "BadStepError",
    "BatchImages",
    "BatchObservation",
    "CapacityError",
    "Client",
    "ConflictError",
    "ConnectionLostError",
    "Control",
    "ControllerTakenError",
    "DriveBatch",
    "DriveSession",
    "EpisodeOverError",
    "Frame",
    "GatewayError",
    "Image",
    "ImageDecodeError",
    "InvalidActionError",
    "InvalidOperationError",
    "InvalidRequestError",
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
    "SensorSpec",
    "SessionClosedError",
    "SessionElsewhereError",
    "StaleRevisionError",
    "StaleStepError",
    "StatusError",
    "StepConflictError",
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
    "AsyncClient": "real2sim._async.client",
    "AsyncDriveBatch": "real2sim._async.drive_batch",
    "AsyncDriveSession": "real2sim._async.drive_session",
    "BatchImages": "real2sim.batch_observation",
    "BatchObservation": "real2sim.batch_observation",
    "Client": "real2sim._sync.client",
    "Control": "real2sim_proto.plans",
    "DriveBatch": "real2sim._sync.drive_batch",
    "DriveSession": "real2sim._sync.drive_session",
    "Frame": "real2sim.images",
    "Image": "real2sim.images",
    "LidarCloud": "real2sim.clouds",
    "LidarSpec": "real2sim_proto.ranging",
    "Observation": "real2sim.observation",
    "PointCloud": "real2sim.clouds",
    "PoseCommand": "real2sim_proto.plans",
    "RadarCloud": "real2sim.clouds",
    "RadarSpec": "real2sim_proto.ranging",
    "SensorSpec": "real2sim_proto.episode",
    "TrajectoryPlan": "real2sim_proto.plans",
    "View": "real2sim.observation",
    "connect": "real2sim._sync.client",
    "connect_async": "real2sim._async.client",
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
    # Names are fetched when they are used, so that importing the package costs nothing.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "__version__":
        value: Any = importlib.import_module("real2sim.version").VERSION
    else:
        value = getattr(importlib.import_module(_ELSEWHERE.get(name, "real2sim.errors")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
