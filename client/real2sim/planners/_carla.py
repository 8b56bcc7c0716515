"""Stand-ins for the CARLA modules that leaderboard agents import, if CARLA is not installed.

They cover the types that an agent needs to receive a route and return a command: value types of
the module ``carla``, ``RoadOption``, ``Track`` and the base class ``AutonomousAgent``. Names and
meanings are CARLA's (leaderboard 2). There is no simulator to connect to.
"""

from __future__ import annotations

import enum
import importlib
import math
import sys
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._session_state import Matrix

MAX_POINT_SPACING = 50.0
"""Spacing of an agent's route points [m]; points where the option changes are added."""


@dataclass
class Vector3D:
    """Unreal's axes: x forward, y to the right, z up."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    def length(self) -> float:
        """Euclidean length."""
        return math.sqrt(self.x**2 + self.y**2 + self.z**2)


@dataclass
class Location(Vector3D):
    """A position [m]."""

    def distance(self, other: Vector3D) -> float:
        """Distance to another location [m]."""
        return math.dist((self.x, self.y, self.z), (other.x, other.y, other.z))


@dataclass
class Rotation:
    """A rotation in degrees: pitch nose up, yaw to the right, roll with the right side down."""

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
    """The manoeuvre at the next route point."""

    VOID = -1
    LEFT = 1
    RIGHT = 2
    STRAIGHT = 3
    LANEFOLLOW = 4
    CHANGELANELEFT = 5
    CHANGELANERIGHT = 6


class Track(enum.Enum):
    """Track of the leaderboard: sensors only, or with a map."""

    SENSORS = "SENSORS"
    MAP = "MAP"


class AutonomousAgent:
    """Base class of agents, which override its methods."""

    def __init__(self, carla_host: str = "", carla_port: int = 0, debug: bool = False) -> None:
        """Host and port are ignored."""
        self.track = Track.SENSORS
        self._global_plan: list[Any] | None = None
        self._global_plan_world_coord: list[Any] | None = None

    def setup(self, path_to_conf_file: str) -> None:
        """Read the agent's own configuration."""

    def sensors(self) -> list[dict[str, Any]]:
        """Sensors that the agent requires."""
        return []

    def set_global_plan(
        self, global_plan_gps: Sequence[Any], global_plan_world_coord: Sequence[Any]
    ) -> None:
        """Store the route with fewer points."""
        kept = _thinned(global_plan_world_coord)
        self._global_plan = [global_plan_gps[k] for k in kept]
        self._global_plan_world_coord = [tuple(global_plan_world_coord[k]) for k in kept]

    def run_step(self, input_data: dict[str, Any], timestamp: float) -> VehicleControl:
        """The command for the current step."""
        return VehicleControl()

    def destroy(self) -> None:
        """Clean up."""


def _thinned(route: Sequence[Any]) -> list[int]:
    """Indices of the route points to keep: the ends, option changes, and points in between."""
    kept, way = [0], 0.0
    for k in range(1, len(route)):
        way += route[k][0].location.distance(route[k - 1][0].location)
        if route[k][1] != route[k - 1][1] or way > MAX_POINT_SPACING or k == len(route) - 1:
            kept.append(k)
            way = 0.0
    return kept


STUBS: dict[str, tuple[Any, ...]] = {
    "carla": (Vector3D, Location, Rotation, Transform, VehicleControl),
    "agents.navigation.local_planner": (RoadOption,),
    "leaderboard.autoagents.autonomous_agent": (AutonomousAgent, Track),
}
"""Members of each stand-in module."""


def install_stubs() -> None:
    """Make the modules of :data:`STUBS` importable; installed ones take precedence."""
    for name, members in STUBS.items():
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


# Images of a camera that a scene lacks, resampled from its other cameras. The cameras of a vehicle
# are close together, so each ray is looked up by its direction, without parallax.

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A pinhole camera on the vehicle.

    Attributes:
        K: [3, 3] intrinsics [px].
        size: width, height [px].
        R_vehicle_camera: [3, 3] rotation of its axes (x right, y down, z forward).
    """

    K: Matrix
    size: tuple[int, int]
    R_vehicle_camera: Matrix

    def rays(self) -> Matrix:
        """[H, W, 3] directions of its pixels' centres in the vehicle frame."""
        width, height = self.size
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        inverse = np.linalg.inv(self.K)
        directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ inverse.T
        rays: Matrix = directions @ self.R_vehicle_camera.T
        return rays

    def apart(self, other: PinholeView) -> float:
        """Angle between the axes of two cameras [rad]."""
        cosine = float(self.R_vehicle_camera[:, 2] @ other.R_vehicle_camera[:, 2])
        return math.acos(min(max(cosine, -1.0), 1.0))


@dataclass(frozen=True, eq=False)
class Lookup:
    """Source pixels of a requested view.

    Attributes:
        size: width and height of the view [px].
        parts: for each contributing camera its name, the indices of the view's pixels [N], and for
            each the four surrounding pixels and their weights [N, 4].
        covered: fraction of the view that any camera sees.
    """

    size: tuple[int, int]
    parts: tuple[tuple[str, NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]], ...]
    covered: float

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that see any part of the view."""
        return tuple(name for name, *_ in self.parts)

    def image(self, images: Mapping[str, Pixels]) -> Pixels:
        """Assemble the view [H, W, 3] from the cameras' images; unseen pixels are black."""
        width, height = self.size
        found = np.zeros((height * width, 3), np.uint8)
        for name, rows, around, weights in self.parts:
            pixels = images[name].reshape(-1, 3)
            mixed = np.einsum("nk,nkc->nc", weights, pixels[around].astype(np.float32))
            found[rows] = np.rint(mixed).astype(np.uint8)
        return found.reshape(height, width, 3)


def lookup_of(wanted: PinholeView, cameras: Mapping[str, PinholeView]) -> Lookup:
    """For each pixel of ``wanted``, the source camera and pixel: the camera with the most similar
    direction first, then the next one for the remaining pixels."""
    rays = wanted.rays().reshape(-1, 3)
    free = np.ones(len(rays), np.bool_)
    parts = []
    for name in _nearest_first(wanted, cameras):
        camera = cameras[name]
        rows = np.flatnonzero(free)
        local = rays[rows] @ camera.R_vehicle_camera
        ahead = local[:, 2] > 1e-6
        rows, local = rows[ahead], local[ahead]
        places = (local / local[:, 2:]) @ camera.K.T
        width, height = camera.size
        seen = (
            (places[:, 0] >= 0) & (places[:, 0] < width)
            & (places[:, 1] >= 0) & (places[:, 1] < height)
        )  # fmt: skip
        if not seen.any():
            continue
        rows = rows[seen]
        around, weights = _around(places[seen, :2], width, height)
        parts.append((name, rows, around, weights))
        free[rows] = False
    return Lookup(wanted.size, tuple(parts), float(1.0 - free.mean()))


def _nearest_first(wanted: PinholeView, cameras: Mapping[str, PinholeView]) -> Sequence[str]:
    return sorted(cameras, key=lambda name: (wanted.apart(cameras[name]), name))


def _around(
    places: Matrix, width: int, height: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The four pixels around positions [N, 2] in an image, and their bilinear weights."""
    place = places - 0.5
    low = np.floor(place)
    a, b = (place - low).T
    i, j = low.astype(np.int64).T
    columns = [np.clip(i, 0, width - 1), np.clip(i + 1, 0, width - 1)]
    lines = [np.clip(j, 0, height - 1), np.clip(j + 1, 0, height - 1)]
    around = np.stack([line * width + column for line in lines for column in columns], axis=1)
    weights = np.stack([(1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a], axis=1)
    return around, weights.astype(np.float32)
