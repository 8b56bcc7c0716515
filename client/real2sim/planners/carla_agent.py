"""Agents of the CARLA leaderboard, unchanged and without CARLA.

An agent is a class with ``setup``, ``sensors``, ``set_global_plan`` and ``run_step``, in a file
whose ``get_entry_point()`` returns the class name. CARLA's vehicle frame is left-handed: x
forward, y right, z up, with its origin at the centre of the vehicle on the ground. Its world is
ours with y negated.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.plans import Control

from .._session_state import Matrix
from ..images import Frame
from ._carla import Lookup, PinholeView, install_stubs, lookup_of
from .peer import PeerError, T_ego_camera, rgb_frames
from .planner import Needs

if TYPE_CHECKING:
    from real2sim_proto.drive import EgoState, Welcome
    from real2sim_proto.scenes import CameraInfo

    from ..observation import Observation

CAMERA = "sensor.camera.rgb"
OTHER_SENSORS = ("sensor.other.gnss", "sensor.other.imu", "sensor.speedometer")

REAR_OVERHANG = 0.95
"""Rear axle to the rear end of the ego's box [m]; CARLA's origin is the middle of the box."""

MIN_SEEN, MAX_UNSEEN = 0.2, 0.1
"""Fractions of an agent's image: minimum seen, and maximum unseen without a warning."""

EARTH_RADIUS = 6_378_137.0
"""Radius of CARLA's spherical earth [m]."""

GRAVITY = 9.81

# The longitudinal map, see command_of().
FULL_THROTTLE, FULL_BRAKE = 4.0, 8.0
"""Acceleration at full throttle, and deceleration at full brake [m/s^2]."""
TOP_SPEED = 50.0
"""Speed at which full throttle no longer accelerates [m/s]."""
ROLLING, AIR = 0.15, 6e-4
"""Deceleration by rolling resistance [m/s^2], and by air drag per squared speed [1/m]."""
STEER_ANGLE = math.radians(70.0)
"""Road-wheel angle of most CARLA cars at full steer [rad]."""
STEERING_CURVE = ((0.0, 20.0, 60.0, 120.0), (1.0, 0.9, 0.8, 0.7))
"""Fraction of full steering at speeds [km/h], as in CARLA."""

TURN_OVER, TURN = 15.0, 0.5
"""A route turns at a point if its heading changes by more than ``TURN`` [rad] between
``TURN_OVER`` [m] before and after the point."""


@dataclass(frozen=True)
class _AgentNeeds(Needs):
    """Needs of an agent: the cameras of the scene that cover those of the agent.

    Attributes:
        views: cameras that the agent requires, by id.
    """

    views: Mapping[str, PinholeView] = field(default_factory=dict)

    def sensors(self, cameras: Sequence[CameraInfo]) -> list[dict[str, Any]]:
        there = {c.name: _scene_view(c) for c in cameras}
        widths: dict[str, int] = {}
        for name, wanted in self.views.items():
            coarse = lookup_of(_smaller(wanted, 48), there)
            if coarse.covered < MIN_SEEN:
                raise PeerError(
                    f"the agent's camera {name!r} looks where the scene's cameras "
                    f"({', '.join(there) or 'none'}) see {coarse.covered:.0%} of its image",
                    hint="use a scene with a camera facing that direction, or turn the agent's",
                )
            for camera in coarse.cameras:
                there_is = there[camera]
                finer = wanted.K[0, 0] / there_is.K[0, 0]
                width = min(math.ceil(there_is.size[0] * finer), there_is.size[0])
                widths[camera] = max(widths.get(camera, 16), width)
        return [{"camera": c, "modalities": ["rgb"], "width": w} for c, w in widths.items()]


class CarlaAgent:
    """Runs an agent of the CARLA leaderboard in a session.

    Images of its cameras are assembled from those of the scene, by direction and field of view.
    ``gnss``, ``imu`` and ``speedometer`` are exact; other sensors are refused.
    """

    def __init__(self, target: str) -> None:
        """Load an agent.

        Args:
            target: ``FILE`` with a ``get_entry_point()``, or ``module:Class``; ``?config=PATH`` is
                passed to its ``setup``, ``&lat=`` and ``&lon=`` set the world's origin
                (default: 42, 2 degrees, as in CARLA's leaderboard).

        Raises:
            PeerError: the agent does not exist or requires something unavailable.
            ValueError: an unknown option.
        """
        where, options = _split(target)
        self._config = options.pop("config", "")
        self._origin = float(options.pop("lat", 42.0)), float(options.pop("lon", 2.0))
        if options:
            raise ValueError(f"options {', '.join(options)} are unknown; there: config, lat, lon")
        install_stubs()
        self._class = _agent_class(where)
        self._agent: Any = None
        self._route: Matrix | None = None
        self._lookups: dict[str, Lookup] = {}
        self._start_us = 0
        self._next_agent = self._made()
        self._sensors = self._asked_for(self._next_agent)
        cameras = {s["id"]: wanted_view(s) for s in self._sensors if s["type"] == CAMERA}
        modalities: Any = ("rgb",) if cameras else ()
        self.needs: Needs = _AgentNeeds(modalities=modalities, action="control", views=cameras)

    def begin(self, welcome: Welcome) -> None:
        """Store the route of the session."""
        route = welcome.route
        self._route = None if route is None else np.asarray(route, np.float64)

    def reset(self, obs: Observation) -> None:
        """Create a new agent for the episode, with its route."""
        agent, self._next_agent = self._next_agent or self._made(), None
        self.close()
        self._agent, self._start_us = agent, obs.t_us
        route = self._route if self._route is not None else _route_seen(obs)
        agent.set_global_plan(*global_plan(route, *self._origin))
        views = self.needs.views if isinstance(self.needs, _AgentNeeds) else {}
        there = _views_in(obs) if views else {}
        self._lookups = {name: lookup_of(wanted, there) for name, wanted in views.items()}
        for name, lookup in self._lookups.items():
            if lookup.covered < 1 - MAX_UNSEEN:
                warnings.warn(
                    f"{1 - lookup.covered:.0%} of the agent's camera {name!r} stay black: no "
                    "camera of the scene looks there",
                    stacklevel=2,
                )

    def plan(self, obs: Observation) -> Control:
        """Pass the sensor data to the agent and return its command. Raises PeerError."""
        timestamp = (obs.t_us - self._start_us) * 1e-6
        answer = self._agent.run_step(self._inputs(obs), timestamp)
        return command_of(answer, obs.ego.speed)

    def close(self) -> None:
        """Call the agent's cleanup."""
        for agent in (self._agent, self._next_agent):
            if agent is not None:
                agent.destroy()
        self._agent = self._next_agent = None

    @staticmethod
    def _asked_for(agent: Any) -> list[dict[str, Any]]:
        sensors = [dict(sensor) for sensor in agent.sensors()]
        for sensor in sensors:
            kind = sensor.get("type")
            if kind != CAMERA and kind not in OTHER_SENSORS:
                raise PeerError(
                    f"the agent's sensor {sensor.get('id')!r} is an unsupported {kind!r}",
                    hint=f"there are {', '.join((CAMERA, *OTHER_SENSORS))}",
                )
        return sensors

    def _made(self) -> Any:
        """Create an agent and call its setup."""
        parameters = list(inspect.signature(self._class).parameters)
        if len(parameters) == 1 and parameters[0] != "carla_host":
            # Leaderboard 1 passes the configuration to the constructor, which calls setup.
            return self._class(self._config)
        agent = self._class("127.0.0.1", 2000) if parameters else self._class()
        agent.setup(self._config)
        return agent

    def _inputs(self, obs: Observation) -> dict[str, tuple[int, Any]]:
        frames = rgb_frames(obs) if self._lookups else {}
        images = {name: _rgb(frame) for name, frame in frames.items()}
        found: dict[str, tuple[int, Any]] = {}
        for sensor in self._sensors:
            name, kind = sensor["id"], sensor["type"]
            if kind == CAMERA:
                data: Any = _bgra(self._lookups[name].image(images))
            elif kind == "sensor.other.gnss":
                data = self._gnss(sensor, obs.ego)
            elif kind == "sensor.other.imu":
                data = imu(obs.ego)
            else:
                data = {"speed": obs.ego.speed}
            found[name] = (obs.step, data)
        return found

    def _gnss(self, sensor: Mapping[str, Any], ego: EgoState) -> NDArray[np.float64]:
        ahead, left = _middle(ego.size) + sensor.get("x", 0.0), -sensor.get("y", 0.0)
        cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
        x, y, z = ego.position
        place = (x + cos * ahead - sin * left, y + sin * ahead + cos * left)
        lat, lon = geographic(*place, *self._origin)
        return np.array([lat, lon, z + sensor.get("z", 0.0)])


# --- CARLA's frames -------------------------------------------------------------------------------


def wanted_view(sensor: Mapping[str, Any]) -> PinholeView:
    """The view of a camera in an agent's format: size [px], horizontal field of view and angles
    [degrees]."""
    width, height = int(sensor["width"]), int(sensor["height"])
    focal = width / 2 / math.tan(math.radians(float(sensor["fov"])) / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    angles = [math.radians(float(sensor.get(name, 0.0))) for name in ("pitch", "yaw", "roll")]
    return PinholeView(K, (width, height), camera_rotation(*angles))


def camera_rotation(pitch: float, yaw: float, roll: float) -> Matrix:
    """[3, 3] rotation of a camera's axes (x right, y down, z forward) in our vehicle frame, from
    Unreal's angles [rad]: pitch nose up, yaw to the right, roll with the right side down."""
    cp, sp, cy, sy = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    cr, sr = math.cos(roll), math.sin(roll)
    forward = np.array([cp * cy, cp * sy, sp])
    level_right, level_up = np.array([-sy, cy, 0.0]), np.array([-sp * cy, -sp * sy, cp])
    right, up = cr * level_right - sr * level_up, sr * level_right + cr * level_up
    mirror = np.array([1.0, -1.0, 1.0])
    return np.stack([mirror * right, -mirror * up, mirror * forward], axis=1)


def geographic(x: float, y: float, lat: float, lon: float) -> tuple[float, float]:
    """Latitude and longitude [degrees] of a point x (east), y (north) [m] in a world with its
    origin at ``lat``, ``lon``. As in CARLA, a Mercator projection on a sphere, scaled to the
    origin."""
    scale = EARTH_RADIUS * math.cos(math.radians(lat))
    north = scale * math.log(math.tan(math.pi / 4 + math.radians(lat) / 2)) + y
    found = 2 * math.atan(math.exp(north / scale)) - math.pi / 2
    return math.degrees(found), lon + math.degrees(x / scale)


def imu(ego: EgoState) -> NDArray[np.float64]:
    """Accelerometer [m/s^2], gyroscope [rad/s] and compass [rad] on axes x forward, y right, z up.
    At rest the accelerometer measures gravity upwards; the compass is 0 to the north, our y."""
    compass = (math.pi / 2 - ego.yaw) % math.tau
    sideways = ego.speed * ego.yaw_rate
    return np.array([ego.acceleration, -sideways, GRAVITY, 0.0, 0.0, -ego.yaw_rate, compass])


def global_plan(
    route: Matrix, lat: float, lon: float
) -> tuple[list[tuple[dict[str, float], Any]], list[tuple[Any, Any]]]:
    """Convert a route [R, 4] of x, y, z [m] and heading [rad] to the format of agents: positions
    in degrees and as CARLA's transforms, each with its ``RoadOption``."""
    carla = importlib.import_module("carla")
    options = importlib.import_module("agents.navigation.local_planner").RoadOption
    names = {1: options.LEFT, 0: options.LANEFOLLOW, -1: options.RIGHT}
    in_degrees, in_world = [], []
    for (x, y, z, yaw), turn in zip(route.tolist(), _turns(route), strict=True):
        place = geographic(x, y, lat, lon)
        in_degrees.append(({"lat": place[0], "lon": place[1], "z": z}, names[turn]))
        pose = carla.Transform(
            carla.Location(x=x, y=-y, z=z),
            carla.Rotation(pitch=0.0, yaw=-math.degrees(math.remainder(yaw, math.tau)), roll=0.0),
        )
        in_world.append((pose, names[turn]))
    return in_degrees, in_world


def command_of(control: Any, speed: float) -> Control:
    """Convert throttle, brake, steer and reverse of CARLA's ``VehicleControl`` to a command.

    Throttle gives up to 4 m/s^2, decreasing towards 50 m/s. Rolling and air resistance are
    0.15 m/s^2 and 0.0006 times the squared speed while the vehicle moves. Brake gives up to
    8 m/s^2, and the hand brake always 8 m/s^2. Full steer is 70 degrees at the road wheels, less at
    higher speed, and within the vehicle's limit.

    Raises:
        PeerError: not a command, or not finite.
    """
    try:
        throttle, brake, steer = (
            float(getattr(control, n)) for n in ("throttle", "brake", "steer")
        )
    except (AttributeError, TypeError, ValueError) as error:
        raise PeerError(f"run_step answers {control!r}, which is not a VehicleControl") from error
    if not all(map(math.isfinite, (throttle, brake, steer))):
        raise PeerError(f"run_step answers throttle {throttle}, brake {brake}, steer {steer}")
    throttle, brake = min(max(throttle, 0.0), 1.0), min(max(brake, 0.0), 1.0)
    brake = 1.0 if getattr(control, "hand_brake", False) else brake
    fast = abs(speed)
    acceleration = FULL_THROTTLE * throttle * max(1 - fast / TOP_SPEED, 0.0) - FULL_BRAKE * brake
    if fast > 0 or acceleration > 0:
        acceleration -= ROLLING + AIR * fast**2
    most = STEER_ANGLE * float(np.interp(3.6 * fast, *STEERING_CURVE))
    return Control(
        acceleration=acceleration,
        steering=-min(max(steer, -1.0), 1.0) * most,
        gear="reverse" if getattr(control, "reverse", False) else "drive",
    )


# --- data passed to the agent ---------------------------------------------------------------------


def _turns(route: Matrix) -> list[int]:
    """1 at points where the route turns left, -1 where it turns right, 0 elsewhere."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route[:, :2], axis=0).T))])
    yaws = np.unwrap(route[:, 3])
    turned = np.interp(way + TURN_OVER, way, yaws) - np.interp(way - TURN_OVER, way, yaws)
    return [int(turn > TURN) - int(turn < -TURN) for turn in turned.tolist()]


def _route_seen(obs: Observation) -> Matrix:
    """The route in an observation, for workers that do not send the whole route."""
    x, y, z = obs.ego.position
    cos, sin = math.cos(obs.ego.yaw), math.sin(obs.ego.yaw)
    ahead, left = np.vstack([np.zeros(2), obs.route]).T
    places = np.stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left], axis=1)
    steps = np.diff(places, axis=0)
    yaws = np.arctan2(steps[:, 1], steps[:, 0])
    return np.column_stack([places, np.full(len(places), z), np.append(yaws, yaws[-1])])


def _middle(size: Sequence[float]) -> float:
    """Distance of CARLA's origin in front of the rear axle [m]."""
    return size[0] / 2 - REAR_OVERHANG


def _scene_view(camera: CameraInfo) -> PinholeView:
    pose = np.asarray(camera.T_vehicle_camera, np.float64)
    return PinholeView(np.asarray(camera.K), (camera.width, camera.height), pose[:3, :3])


def _views_in(obs: Observation) -> dict[str, PinholeView]:
    return {
        name: PinholeView(
            np.asarray(frame.K),
            (frame.shape[1], frame.shape[0]),
            T_ego_camera(obs, frame)[:3, :3],
        )
        for name, frame in rgb_frames(obs).items()
    }


def _smaller(view: PinholeView, width: int) -> PinholeView:
    """The view with fewer pixels."""
    shrunk = min(width / view.size[0], 1.0)
    size = max(round(view.size[0] * shrunk), 1), max(round(view.size[1] * shrunk), 1)
    K = np.diag([size[0] / view.size[0], size[1] / view.size[1], 1.0]) @ view.K
    return PinholeView(K, size, view.R_vehicle_camera)


def _rgb(frame: Frame) -> NDArray[np.uint8]:
    return np.ascontiguousarray(frame.array, np.uint8)


def _bgra(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W, 4] uint8, blue, green, red and an alpha of 255."""
    alpha = np.full((*image.shape[:2], 1), 255, np.uint8)
    return np.concatenate([image[..., ::-1], alpha], axis=2)


# --- finding an agent -----------------------------------------------------------------------------


def _split(target: str) -> tuple[str, dict[str, str]]:
    where, _, query = target.partition("?")
    return where, dict(parse_qsl(query, keep_blank_values=True))


def _agent_class(where: str) -> Any:
    """The class that a file or ``module:Class`` names. Raises PeerError."""
    try:
        if where.endswith(".py"):
            module = _module_of(Path(where))
            return getattr(module, module.get_entry_point())
        name, _, attribute = where.partition(":")
        module = importlib.import_module(name)
        return getattr(module, attribute or module.get_entry_point())
    except Exception as error:
        raise PeerError(
            f"agent {where!r} cannot be loaded: {error}",
            hint="give a file with get_entry_point(), as agent.py, or 'module:Class'",
        ) from error


def _module_of(file: Path) -> Any:
    spec = importlib.util.spec_from_file_location(file.stem, file)
    if spec is None or spec.loader is None or not file.is_file():
        raise FileNotFoundError(f"there is no file {str(file)!r}")
    # Agents import files from their own folder.
    if (folder := str(file.resolve().parent)) not in sys.path:
        sys.path.insert(0, folder)
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module
    spec.loader.exec_module(module)
    return module
