"""A session as a Gymnasium environment; needs the extra ``real2sim[gym]``.

::

    env = real2sim.make_env(scene="street", sensors=["front"])
    env = gymnasium.make("real2sim.env:real2sim/Drive-v0", scene="street", sensors=["front"])
    obs, info = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from real2sim_proto.plans import Control

from ._handles import ScenarioRef, SceneRef
from ._requests import LidarSensor, RadarSensor, Sensor
from ._sync.client import connect
from .clouds import PointCloud
from .observation import Observation

Obs = dict[str, NDArray[Any]]

ACCELERATION, BRAKING, STEERING = 4.0, 8.0, 0.6
"""Accelerations of the actions 1 and -1 [m/s^2], and steering angle of the action 1 [rad]."""

ENV_ID = "real2sim/Drive-v0"
"""Id for ``gymnasium.make``; importing this module registers it."""

WAYPOINTS = 20
FAR = 1e4
"""Bound of positions in observations [m]."""

AGENTS = 16
"""Number of observed road users for a vehicle without cameras."""
AGENT_FIELDS = 9

POINTS = 8192
"""Default number of LiDAR rows in observations."""
DETECTIONS = 256
"""Number of radar rows in observations."""
CLOUD_FIELDS = {"lidar": ("intensity",), "radar": ("velocity", "rcs")}
"""Columns after x, y, z."""

FORMS: dict[str, tuple[float, type[np.generic]]] = {
    "rgb": (255, np.uint8),
    "depth": (FAR, np.float32),
    "instance": (65535, np.uint16),
    "median_depth": (FAR, np.float32),
    "semantic": (255, np.uint8),
    "uncertainty": (1, np.float32),
}
"""Largest value and dtype of images by modality."""


class DriveEnv(gymnasium.Env[Obs, NDArray[np.float32]]):
    """Driving by acceleration and steering.

    Action: [2] float32 in [-1, 1]: acceleration (1 is 4 m/s^2, -1 brakes by 8 m/s^2) and road-wheel
    angle (1 is 0.6 rad to the left).

    Observation: ``state`` [5] float32 (speed, lateral speed, acceleration, steering, yaw rate; SI),
    ``route`` [20, 2] float32 in the vehicle frame [m], each camera's image under its name, uint8
    [H, W, 3], and other modalities such as ``front/depth`` [H, W] float32 [m] and
    ``front/instance`` [H, W] uint16. ``agents`` [N, 9] float32 are the N road users nearest to the
    vehicle, in its frame: 1, x, y [m], cosine and sine of the heading, velocity along x and y
    [m/s], length, width [m]. A LiDAR under its name is [P, 4] float32: x, y, z [m] and intensity;
    more than P returns are subsampled evenly. A radar is [256, 5] float32: x, y, z, radial velocity
    [m/s] and RCS [dBsm], nearest first. Unused rows are zero. A slower sensor repeats its last
    image or cloud of the episode until the next one is due; before the first one it is all zero.
    The arrays are yours: later steps do not change them.

    Reward: metres of progress along the route, minus 10 for a contact that is the ego's fault,
    minus 0.1 per step off the road. ``info`` has ``metrics``, ``events`` and the episode's randomly
    sampled values in ``drawn``; :attr:`last` is the whole observation.

    The seed of ``reset`` only affects ``randomization`` and ``agents.spawn`` of ``options``;
    without them the episodes of all seeds are identical.

    Args:
        url, token: address and token of the worker; defaults as in :func:`real2sim.connect`.
        scene, scenario: exactly one of them, or its name or id.
        sensors: camera names or specs; a spec selects modalities.
        lidars, radars: names in the worker's catalogues or specs, as in ``DriveSession.reset``.
        points: P, rows of each LiDAR.
        agents: number of observed road users; default: 16 without sensors, else 0.
        options: as in ``DriveSession.reset``. The environment sets ``seed`` and ``action``, and
            also ``privileged`` if it observes agents.

    Examples:
        >>> env = real2sim.make_env(scene="street", sensors=["front"], render_mode="rgb_array")
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        *,
        url: str | None = None,
        token: str | None = None,
        scene: SceneRef | None = None,
        scenario: ScenarioRef | None = None,
        sensors: Sequence[Sensor] = (),
        lidars: Sequence[LidarSensor] = (),
        radars: Sequence[RadarSensor] = (),
        points: int = POINTS,
        agents: int | None = None,
        render_mode: str | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        if render_mode not in {None, "rgb_array"}:
            raise ValueError(f"render_mode {render_mode!r} is unknown; give 'rgb_array' or None")
        if render_mode is not None and not sensors:
            raise ValueError("render_mode 'rgb_array' shows the first camera; name one in sensors")
        self.render_mode = render_mode
        self._sensors = list(sensors)
        self._ranging: dict[str, Any] = {}
        self._ranging |= {"lidars": list(lidars)} if lidars else {}
        self._ranging |= {"radars": list(radars)} if radars else {}
        self._rows = {"lidar": points, "radar": DETECTIONS}
        if points < 1:
            raise ValueError(f"points is {points!r}; give rows of each LiDAR, 1 or more")
        blind = not sensors and not self._ranging
        self._agents = agents if agents is not None else AGENTS if blind else 0
        if self._agents < 0:
            raise ValueError(
                f"agents is {agents!r}; give the number of road users to show, 0 or more"
            )
        self._options = dict(options or {})
        self._fixed = {"action": "control"} | ({"privileged": True} if self._agents else {})
        self._images: dict[str, NDArray[Any]] = {}
        self._clouds: dict[str, NDArray[np.float32]] = {}
        with contextlib.ExitStack() as opened:
            self._client = connect(url, token=token)
            opened.callback(self._client.close)
            self._session = self._client.session(scene=scene, scenario=scenario).open()
            opened.callback(self._session.close)
            self._last = self._begin(0)
            if render_mode is not None and not any("rgb" in m for m in self._last.frames.values()):
                raise ValueError("render_mode 'rgb_array' shows a camera, and no sensor shows rgb")
            opened.pop_all()
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space: spaces.Space[Obs] = self._space(self._last)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Start an episode; ``options`` override those of the environment for this episode.

        Examples:
            >>> obs, info = env.reset(seed=3, options={"dt_us": 50_000})
            >>> obs["state"].shape, obs["route"].shape, obs["front"].shape
            ((5,), (20, 2), (64, 96, 3))
            >>> env.close()
        """
        super().reset(seed=seed)
        drawn = seed if seed is not None else int(self.np_random.integers(2**31))
        self._last = self._begin(drawn, options)
        self._images, self._clouds = {}, {}
        return self._seen(self._last), self._info(self._last)

    def step(self, action: NDArray[np.float32]) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Drive one clock step.

        Examples:
            >>> obs, info = env.reset(seed=0)
            >>> obs, reward, terminated, truncated, info = env.step(np.array([0.5, 0.0]))
            >>> reward > 0, terminated
            (True, False)
            >>> env.close()
        """
        push, turn = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0).tolist()
        plan = Control(
            acceleration=push * (ACCELERATION if push > 0 else BRAKING), steering=turn * STEERING
        )
        before, self._last = self._last, self._session.step(plan)
        reward = _reward(before, self._last)
        last = self._last
        return self._seen(last), reward, last.terminated, last.truncated, self._info(last)

    def render(self) -> NDArray[np.uint8] | None:
        """The newest colour image of the first camera, uint8 [H, W, 3].

        Examples:
            >>> env.render().shape
            (64, 96, 3)
            >>> env.close()
        """
        if self.render_mode is None:
            return None
        # A slower camera repeats its last image.
        shown = self._images or dict(_images_in(self._last))
        return next(image.copy() for name, image in shown.items() if "/" not in name)

    @property
    def last(self) -> Observation:
        """The newest observation, with all fields."""
        return self._last

    def close(self) -> None:
        """End the session.

        Examples:
            >>> env.close()
        """
        self._session.close()
        self._client.close()

    def _begin(self, seed: int, options: Mapping[str, Any] | None = None) -> Observation:
        chosen: Any = self._options | dict(options or {}) | {"seed": seed} | self._fixed
        return self._session.reset(sensors=self._sensors, **self._ranging | chosen)

    def _space(self, obs: Observation) -> Any:
        parts: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(-FAR, FAR, (5,), np.float32),
            "route": spaces.Box(-FAR, FAR, (WAYPOINTS, 2), np.float32),
        }
        for name, image in _images_in(obs):
            most, dtype = FORMS[name.partition("/")[2] or "rgb"]
            parts[name] = spaces.Box(0, most, image.shape, dtype)
        for name, cloud in obs.clouds.items():
            if name in parts:
                raise ValueError(f"two sensors are called {name!r}; name the {cloud.modality} anew")
            shape = (self._rows[cloud.modality], 3 + len(CLOUD_FIELDS[cloud.modality]))
            parts[name] = spaces.Box(-FAR, FAR, shape, np.float32)
        if self._agents:
            parts["agents"] = spaces.Box(-FAR, FAR, (self._agents, AGENT_FIELDS), np.float32)
        return spaces.Dict(parts)

    def _seen(self, obs: Observation) -> Obs:
        ego = obs.ego
        state = [ego.speed, ego.lateral_speed, ego.acceleration, ego.steering, ego.yaw_rate]
        seen: Obs = {
            "state": np.clip(np.array(state, dtype=np.float32), -FAR, FAR),
            "route": np.clip(obs.route, -FAR, FAR).astype(np.float32),
        }
        if self._agents:
            seen["agents"] = _nearest_agents(obs, self._agents)
        # A slower camera repeats its last image until the next one is due.
        for name, image in _images_in(obs):
            most, dtype = FORMS[name.partition("/")[2] or "rgb"]
            self._images[name] = np.minimum(image, most).astype(dtype)
        for name, cloud in obs.clouds.items():
            self._clouds[name] = _rows_of(cloud, self._rows[cloud.modality])
        # Copies: changing an observation in place must not change the next one.
        kept = {**self._images, **self._clouds}
        return seen | {name: array.copy() for name, array in kept.items()}

    @staticmethod
    def _info(obs: Observation) -> dict[str, Any]:
        return {
            "metrics": dict(obs.metrics),
            "events": [e.model_dump() for e in obs.events],
            "drawn": dict(obs.drawn),
        }


def _images_in(obs: Observation) -> Iterator[tuple[str, NDArray[Any]]]:
    """Images by their observation keys; rgb uses the camera's name."""
    for camera, modalities in obs.frames.items():
        for modality in modalities:
            name = camera if modality == "rgb" else f"{camera}/{modality}"
            yield name, obs.image(camera, modality)


def _rows_of(cloud: PointCloud, count: int) -> NDArray[np.float32]:
    """[count, 3 + columns]; see :class:`DriveEnv`."""
    columns = [cloud.points, *(cloud.columns[n][:, None] for n in CLOUD_FIELDS[cloud.modality])]
    found = np.concatenate(columns, axis=1).astype(np.float32)
    if len(found) > count and cloud.modality == "lidar":
        found = found[np.arange(count) * len(found) // count]
    rows = np.zeros((count, found.shape[1]), np.float32)
    rows[: len(found)] = np.clip(found[:count], -FAR, FAR)
    return rows


def _nearest_agents(obs: Observation, count: int) -> NDArray[np.float32]:
    """[count, 9] in the vehicle frame; see :class:`DriveEnv`."""
    rows = np.zeros((count, AGENT_FIELDS), np.float32)
    if not obs.agents:
        return rows
    ahead, left = math.cos(obs.ego.yaw), math.sin(obs.ego.yaw)
    turn = np.array([[ahead, left], [-left, ahead]])
    positions = np.array([agent.position[:2] for agent in obs.agents]) - obs.ego.position[:2]
    velocities = np.array([agent.velocity[:2] for agent in obs.agents])
    # Ties in distance are ordered by id, so the result does not depend on the input order.
    distances = np.linalg.norm(positions, axis=1)
    ids = np.array([agent.object_id for agent in obs.agents])
    nearest = np.lexsort((ids, distances))[:count]
    w, x, y, z = np.array([obs.agents[k].quaternion for k in nearest]).T
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) - obs.ego.yaw
    found = np.column_stack(
        [
            np.ones(len(nearest)),
            positions[nearest] @ turn.T,
            np.cos(heading),
            np.sin(heading),
            velocities[nearest] @ turn.T,
            [obs.agents[k].size[:2] for k in nearest],
        ]
    )
    rows[: len(nearest)] = np.clip(found, -FAR, FAR)
    return rows


def _reward(before: Observation, now: Observation) -> float:
    def gained(name: str) -> float:
        return now.metrics.get(name, 0.0) - before.metrics.get(name, 0.0)

    off_road = 1.0 - now.metrics.get("on_road", 1.0)
    reward = gained("route_progress") - 10.0 * gained("at_fault_collisions") - 0.1 * off_road
    return reward if math.isfinite(reward) else 0.0


gymnasium.register(id=ENV_ID, entry_point="real2sim.env:DriveEnv")
