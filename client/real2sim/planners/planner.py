"""What a planner is, what it wants to see, and how one is found by name."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

if TYPE_CHECKING:
    from real2sim_proto.base import Modality
    from real2sim_proto.plans import Plan
    from real2sim_proto.scenes import CameraInfo

    from ..observation import Observation

BUILT_IN = {
    "follow_route": "real2sim.planners.follow_route:FollowRoute",
    "pid": "real2sim.planners.pid:PidFollowRoute",
    "idm": "real2sim.planners.idm:Idm",
    "depth_sampling": "real2sim.planners.depth_sampling:DepthSampling",
    "learned": "real2sim.planners.learned:LearnedPolicy",
    "neuroncap": "real2sim.planners.neuroncap:NeuroNcap",
    "alpasim": "real2sim.planners.alpasim:AlpasimDriver",
    "carla": "real2sim.planners.carla_agent:CarlaAgent",
}


@runtime_checkable
class Planner(Protocol):
    """Drives: sees observations, answers with plans.

    One that must see more than the ego and its route has an attribute ``needs``: :class:`Needs`.
    One that must know the session's cameras or its whole route has a method ``begin(welcome)``,
    which is called before ``reset``.
    """

    def reset(self, obs: Observation) -> None:
        """Forget the last episode; ``obs`` is the first of the new one."""

    def plan(self, obs: Observation) -> Plan | Mapping[str, Any]:
        """The answer to an observation: a trajectory, a control or a pose."""


@dataclass(frozen=True)
class Needs:
    """What a planner must be shown, and how it drives.

    Attributes:
        modalities: of its cameras; empty where it is blind.
        cameras: by name; empty: the one that looks most nearly straight ahead.
        all_cameras: whether it wants every camera of the scene instead.
        width: of its images [px]; None: as recorded.
        privileged: whether observations list all objects.
        action: kind of its plans.
    """

    modalities: tuple[Modality, ...] = ()
    cameras: tuple[str, ...] = ()
    width: int | None = None
    privileged: bool = False
    action: Literal["trajectory", "control", "pose"] = "trajectory"
    all_cameras: bool = False

    def sensors(self, cameras: Sequence[CameraInfo]) -> list[dict[str, Any]]:
        """Sensors to reset with, out of a session's cameras.

        Raises:
            ValueError: a camera that the scene lacks.

        Examples:
            >>> with real2sim.connect() as client:
            ...     cameras = client.scenes.get("street").cameras
            >>> Needs(modalities=("rgb",), width=64).sensors(cameras)
            [{'camera': 'front', 'modalities': ['rgb'], 'width': 64}]
        """
        if not self.modalities:
            return []
        there = [camera.name for camera in cameras]
        missing = [name for name in self.cameras if name not in there]
        if missing or not there:
            raise ValueError(
                f"the planner wants camera {(missing or ['any'])[0]!r}; the scene has "
                f"{', '.join(there) or 'none'}"
            )
        return [
            {"camera": name, "modalities": list(self.modalities), "width": self.width}
            for name in (there if self.all_cameras else self.cameras or [forward_camera(cameras)])
        ]


def needs_of(planner: Planner) -> Needs:
    """What a planner asks for; nothing where it does not say.

    Examples:
        >>> needs_of(load_planner("depth_sampling")).modalities
        ('depth',)
    """
    found = getattr(planner, "needs", None)
    return found if isinstance(found, Needs) else Needs()


def forward_camera(cameras: Sequence[CameraInfo]) -> str:
    """Name of the camera whose axis is nearest to the vehicle's x axis; the first of equals."""
    # The optical axis is z of the camera frame, so its part along vehicle x is element [0, 2].
    return max(cameras, key=lambda camera: camera.T_vehicle_camera[0][2]).name


def load_planner(name: str) -> Planner:
    """A planner by name: a built-in one, or ``module:Class``.

    It is made without arguments; what follows a ``=`` becomes its one argument, as in
    ``learned=policy.safetensors`` or ``neuroncap=http://127.0.0.1:9000``. Modules are looked for
    in the working folder too.

    Raises:
        ValueError: no such module or class, or it is not a planner.

    Examples:
        >>> load_planner("idm").speed
        8.0
        >>> load_planner("cruise_control")
        Traceback (most recent call last):
        ValueError: planner 'cruise_control' is unknown; give alpasim, ... or 'module:Class'
    """
    given, equals, argument = name.partition("=")
    module_name, colon, attribute = BUILT_IN.get(given, given).partition(":")
    if not colon:
        known = ", ".join(sorted(BUILT_IN))
        raise ValueError(f"planner {name!r} is unknown; give {known} or 'module:Class'")
    if (folder := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, folder)
    try:
        make = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"planner {name!r} cannot be loaded: {error}") from error
    try:
        planner = make(argument) if equals else make()
    except TypeError as error:
        raise ValueError(f"planner {name!r} cannot be made: {error}") from error
    if not isinstance(planner, Planner):
        raise ValueError(f"planner {name!r} needs the methods reset(obs) and plan(obs)")
    return planner
