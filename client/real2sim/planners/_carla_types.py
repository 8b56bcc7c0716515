"""What agents of the CARLA leaderboard import, where CARLA itself is not installed.

Only what an agent needs to take a route and to answer with a command: value types of the module
``carla``, ``RoadOption``, ``Track`` and the base class ``AutonomousAgent``. Names and meanings are
CARLA's (leaderboard 2); a simulator to connect to is not there.
"""

from __future__ import annotations

import enum
import importlib
import math
import sys
import types
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

WAY_BETWEEN = 50.0
"""An agent keeps points of its route so far apart, and those where its option changes [m]."""


@dataclass
class Vector3D:
    """Of Unreal's axes: x forward, y to the right, z up."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    def length(self) -> float:
        """Euclidean."""
        return math.sqrt(self.x**2 + self.y**2 + self.z**2)


@dataclass
class Location(Vector3D):
    """[m]"""

    def distance(self, other: Vector3D) -> float:
        """To another location [m]."""
        return math.dist((self.x, self.y, self.z), (other.x, other.y, other.z))


@dataclass
class Rotation:
    """Degrees: pitch nose up, yaw to the right, roll with the right side down."""

    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


@dataclass
class Transform:
    """A pose."""

    location: Location = field(default_factory=Location)
    rotation: Rotation = field(default_factory=Rotation)


@dataclass
class VehicleControl:
    """A command: throttle and brake 0 to 1, steer -1 (left) to 1 (right)."""

    throttle: float = 0.0
    steer: float = 0.0
    brake: float = 0.0
    hand_brake: bool = False
    reverse: bool = False
    manual_gear_shift: bool = False
    gear: int = 0


class RoadOption(enum.IntEnum):
    """What to do at the next place of a route."""

    VOID = -1
    LEFT = 1
    RIGHT = 2
    STRAIGHT = 3
    LANEFOLLOW = 4
    CHANGELANELEFT = 5
    CHANGELANERIGHT = 6


class Track(enum.Enum):
    """Of the leaderboard: with sensors alone, or with a map as well."""

    SENSORS = "SENSORS"
    MAP = "MAP"


class AutonomousAgent:
    """Base class of agents, which overwrite what they need."""

    def __init__(self, carla_host: str = "", carla_port: int = 0, debug: bool = False) -> None:
        """Neither host nor port leads anywhere here."""
        self.track = Track.SENSORS
        self._global_plan: list[Any] | None = None
        self._global_plan_world_coord: list[Any] | None = None

    def setup(self, path_to_conf_file: str) -> None:
        """Read the agent's own configuration."""

    def sensors(self) -> list[dict[str, Any]]:
        """What the agent wants to see."""
        return []

    def set_global_plan(
        self, global_plan_gps: Sequence[Any], global_plan_world_coord: Sequence[Any]
    ) -> None:
        """Keep the route, thinned."""
        kept = _thinned(global_plan_world_coord)
        self._global_plan = [global_plan_gps[k] for k in kept]
        self._global_plan_world_coord = [tuple(global_plan_world_coord[k]) for k in kept]

    def run_step(self, input_data: dict[str, Any], timestamp: float) -> VehicleControl:
        """The command for now."""
        return VehicleControl()

    def destroy(self) -> None:
        """Clean up."""


def _thinned(route: Sequence[Any]) -> list[int]:
    """Rows of a route that an agent keeps: its ends, where its option changes, and in between."""
    kept, way = [0], 0.0
    for k in range(1, len(route)):
        way += route[k][0].location.distance(route[k - 1][0].location)
        if route[k][1] != route[k - 1][1] or way > WAY_BETWEEN or k == len(route) - 1:
            kept.append(k)
            way = 0.0
    return kept


STAND_INS: dict[str, tuple[Any, ...]] = {
    "carla": (Vector3D, Location, Rotation, Transform, VehicleControl),
    "agents.navigation.local_planner": (RoadOption,),
    "leaderboard.autoagents.autonomous_agent": (AutonomousAgent, Track),
}
"""What modules offer, where they cannot be imported."""


def offer_stand_ins() -> None:
    """Let agents import the modules of :data:`STAND_INS`; installed ones are left alone."""
    for name, members in STAND_INS.items():
        try:
            importlib.import_module(name)
        except ImportError:
            _offer(name, members)


def _offer(name: str, members: tuple[Any, ...]) -> None:
    parent, _, last = name.rpartition(".")
    if parent and parent not in sys.modules:
        _offer(parent, ())
    module = types.ModuleType(name, "Stand-in of real2sim; see real2sim.planners.carla_agent.")
    module.__path__ = []
    for member in members:
        setattr(module, member.__name__, member)
    sys.modules[name] = module
    if parent:
        setattr(sys.modules[parent], last, module)
