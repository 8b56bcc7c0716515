"""A session as a Gymnasium environment; needs the extra ``real2sim[gym]``.

::

    env = real2sim.make_env(scene="street", sensors=["front"])
    obs, info = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from real2sim_proto.plans import Control

from ._references import ScenarioRef, SceneRef
from ._sensors import Sensor
from ._sync.client import connect
from .observation import Observation

Obs = dict[str, NDArray[Any]]

ACCELERATION, BRAKING, STEERING = 4.0, 8.0, 0.6
"""What an action of 1, -1 and, sideways, 1 stands for [m/s^2], [rad]."""

WAYPOINTS = 20
FAR = 1e4
"""Bound of positions in observations [m]."""


class DriveEnv(gymnasium.Env[Obs, NDArray[np.float32]]):
    """Driving by acceleration and steering.

    Action: [2] float32 in [-1, 1]: acceleration (1 is 4 m/s^2, -1 brakes by 8 m/s^2) and road-wheel
    angle (1 is 0.6 rad to the left).

    Observation: ``state`` [5] float32 (speed, lateral speed, acceleration, steering, yaw rate; SI),
    ``route`` [20, 2] float32 in the vehicle frame [m], and each camera's image under its name,
    uint8 [H, W, 3].

    Reward: metres of way along the route, less 10 for a contact that the ego is to blame for, less
    0.1 for a step off the road. ``info`` has ``metrics``, ``events`` and what the seed has
    ``drawn`` for the episode; :attr:`last` is the whole observation.

    The seed of ``reset`` draws what ``options`` name in ``randomization`` and ``agents.spawn``;
    without them episodes of all seeds are the same.

    Args:
        url, token: of the worker; defaults as of :func:`real2sim.connect`.
        scene, scenario: exactly one of them, or its name or id.
        sensors: camera names or specs; all rgb.
        options: of ``DriveSession.reset``; ``seed`` and ``action`` are the environment's.

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
        render_mode: str | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        if render_mode not in {None, "rgb_array"}:
            raise ValueError(f"render_mode {render_mode!r} is unknown; give 'rgb_array' or None")
        if render_mode is not None and not sensors:
            raise ValueError("render_mode 'rgb_array' shows the first camera; name one in sensors")
        self.render_mode = render_mode
        self._sensors = list(sensors)
        self._options = dict(options or {}) | {"action": "control"}
        self._client = connect(url, token=token)
        try:
            self._session = self._client.session(scene=scene, scenario=scenario).open()
        except BaseException:
            self._client.close()
            raise
        self._images: dict[str, NDArray[Any]] = {}
        self._last = self._begin(0)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space: spaces.Space[Obs] = self._space(self._last)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Start an episode; ``options`` override those of the environment for this one.

        Examples:
            >>> obs, info = env.reset(seed=3, options={"dt_us": 50_000})
            >>> obs["state"].shape, obs["route"].shape, obs["front"].shape
            ((5,), (20, 2), (64, 96, 3))
            >>> env.close()
        """
        super().reset(seed=seed)
        drawn = seed if seed is not None else int(self.np_random.integers(2**31))
        self._last = self._begin(drawn, options)
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
        """The newest image of the first camera, uint8 [H, W, 3].

        Examples:
            >>> env.render().shape
            (64, 96, 3)
            >>> env.close()
        """
        if self.render_mode is None:
            return None
        return self._last.image(next(iter(self._last.frames)))

    @property
    def last(self) -> Observation:
        """The newest observation, whole."""
        return self._last

    def close(self) -> None:
        """End the session.

        Examples:
            >>> env.close()
        """
        self._session.close()
        self._client.close()

    def _begin(self, seed: int, options: Mapping[str, Any] | None = None) -> Observation:
        chosen: Any = self._options | dict(options or {}) | {"seed": seed, "action": "control"}
        return self._session.reset(sensors=self._sensors, **chosen)

    def _space(self, obs: Observation) -> Any:
        parts: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(-FAR, FAR, (5,), np.float32),
            "route": spaces.Box(-FAR, FAR, (WAYPOINTS, 2), np.float32),
        }
        for camera in obs.frames:
            parts[camera] = spaces.Box(0, 255, obs.image(camera).shape, np.uint8)
        return spaces.Dict(parts)

    def _seen(self, obs: Observation) -> Obs:
        ego = obs.ego
        state = [ego.speed, ego.lateral_speed, ego.acceleration, ego.steering, ego.yaw_rate]
        seen: Obs = {
            "state": np.clip(np.array(state, dtype=np.float32), -FAR, FAR),
            "route": np.clip(obs.route, -FAR, FAR).astype(np.float32),
        }
        # A slower camera keeps its last image until the next one is due.
        for camera in obs.frames:
            self._images[camera] = np.array(obs.image(camera))
        return seen | self._images

    @staticmethod
    def _info(obs: Observation) -> dict[str, Any]:
        return {
            "metrics": dict(obs.metrics),
            "events": [e.model_dump() for e in obs.events],
            "drawn": dict(obs.drawn),
        }


def _reward(before: Observation, now: Observation) -> float:
    def gained(name: str) -> float:
        return now.metrics.get(name, 0.0) - before.metrics.get(name, 0.0)

    off_road = 1.0 - now.metrics.get("on_road", 1.0)
    reward = gained("route_progress") - 10.0 * gained("at_fault_collisions") - 0.1 * off_road
    return reward if math.isfinite(reward) else 0.0
