"""Many sessions of a worker as one Gymnasium vector environment; needs ``real2sim[gym]``.

::

    import gymnasium

    env = gymnasium.make_vec(
        "real2sim.vector_env:real2sim/DriveVector-v0", num_envs=16, scene="street"
    )
    obs, info = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from real2sim_proto.drive_batch import ControlPlans

from ._protocol import error_of
from ._references import ScenarioRef, SceneRef
from ._sensors import Sensor
from ._sync.client import connect
from .batch_observation import BatchObservation
from .env import ACCELERATION, BRAKING, FAR, FORMS, STEERING, WAYPOINTS

Arrays = dict[str, NDArray[Any]]

VECTOR_ENV_ID = "real2sim/DriveVector-v0"
"""For ``gymnasium.make_vec``, once this module is imported."""

STATE = ("speed", "lateral_speed", "acceleration", "steering", "yaw_rate")


class DriveVectorEnv(VectorEnv[Arrays, NDArray[np.float32], Arrays]):
    """N sessions that are stepped by one message; each does what ``real2sim.DriveEnv`` does.

    Actions, observations (``state`` [N, 5], ``route`` [N, 20, 2] float32, the images of each sensor
    [N, H, W, ...] under the names that they have there) and rewards are those of the single
    environment without agents. Ended worlds are reset as Gymnasium's ``autoreset_mode`` says.
    ``info`` has ``metrics``: [N] float64 by name.

    The worker has to have N sessions free (``REAL2SIM_MAX_SESSIONS``). For worlds in the process of
    the learner see ``real2sim_server.learning``.

    Args:
        num_envs: N, 1 to 256.
        url, token: of the worker; defaults as of :func:`real2sim.connect`.
        scene, scenario: exactly one of them, or its name or id.
        sensors: camera names or specs, as of ``DriveBatch.reset``.
        options: of ``DriveBatch.reset``; ``seed`` and ``action`` are the environment's.
        autoreset_mode: of Gymnasium: at the next step (its default), in the same step, or not.

    Raises:
        StatusError: a world refuses what it is told, and why.

    Examples:
        >>> from real2sim.vector_env import DriveVectorEnv
        >>> env = DriveVectorEnv(num_envs=2, scene="street", options={"horizon": 8})
        >>> obs, info = env.reset(seed=0)
        >>> obs["state"].shape, obs["route"].shape
        ((2, 5), (2, 20, 2))
        >>> obs, reward, terminated, truncated, info = env.step(np.tile([0.5, 0.0], (2, 1)))
        >>> bool((reward > 0).all()), terminated.tolist()
        (True, [False, False])
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        url: str | None = None,
        token: str | None = None,
        scene: SceneRef | None = None,
        scenario: ScenarioRef | None = None,
        sensors: Sequence[Sensor] = (),
        options: Mapping[str, Any] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        fixed = {"sensors": list(sensors), "action": "control"}
        self._options: dict[str, Any] = {**dict(options or {}), **fixed}
        self.single_action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._random = [seeding.np_random()[0] for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, np.bool_)
        self._seen: Arrays = {
            "state": np.zeros((num_envs, len(STATE)), np.float32),
            "route": np.zeros((num_envs, WAYPOINTS, 2), np.float32),
        }
        self._metrics: Arrays = {}
        with contextlib.ExitStack() as opened:
            self._client = connect(url, token=token)
            opened.callback(self._client.close)
            self._batch = self._client.batch(scene=scene, scenario=scenario, worlds=num_envs).open()
            opened.callback(self._batch.close)
            # What the options get wrong is said here, where they are given.
            self._begin(np.ones(num_envs, np.bool_), [0] * num_envs)
            opened.pop_all()
        self.single_observation_space: Any = self._space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Arrays, dict[str, Any]]:
        """Begin all episodes, or those of ``options["reset_mask"]`` [N] bool.

        Args:
            seed: of the first world, the others count on from there; or one for each. Later
                episodes draw theirs from it.
            options: ``reset_mask`` alone.

        Raises:
            ValueError: a seed or a mask of another length, or other options.

        Examples:
            >>> obs, info = env.reset(seed=[3, 4])
            >>> env.close()
        """
        where = self._mask(options)
        given = self._seeds(seed)
        for w in np.flatnonzero(where).tolist():
            if given[w] is not None:
                self._random[w] = seeding.np_random(given[w])[0]
        self._begin(where, [s if s is not None else self._drawn(w) for w, s in enumerate(given)])
        self._ended[where] = False
        return self._observed(), self._info()

    def step(  # type: ignore[override]
        self, actions: ArrayLike
    ) -> tuple[Arrays, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Drive one clock step in every world.

        Args:
            actions: [N, 2] in [-1, 1], as of ``real2sim.DriveEnv``.

        Examples:
            >>> obs, info = env.reset(seed=0)
            >>> obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
            >>> env.close()
        """
        going, again = ~self._ended, self._ended
        if self.autoreset_mode is AutoresetMode.DISABLED and again.any():
            raise ValueError(
                f"worlds {np.flatnonzero(again).tolist()} have ended; reset them by "
                "options={'reset_mask': ...}, or choose another autoreset_mode"
            )
        values = _commands(actions, self.num_envs)
        reward = np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        if going.any():
            before = {name: values.copy() for name, values in self._metrics.items()}
            moving = np.flatnonzero(going)
            obs = self._batch.step(ControlPlans(values=values[moving]), worlds=moving.tolist())
            self._take(obs)
            terminated[obs.worlds], truncated[obs.worlds] = obs.terminated, obs.truncated
            reward[moving] = _rewards(before, self._metrics)[moving]
        self._ended = terminated | truncated
        if again.any():
            self._begin(again, [self._drawn(w) for w in range(self.num_envs)])
        info = self._info()
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            info = self._same_step(info)
        return self._observed(), reward, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """End the sessions.

        Examples:
            >>> env.close()
        """
        self._batch.close()
        self._client.close()

    def _same_step(self, info: dict[str, Any]) -> dict[str, Any]:
        """Begin ended worlds anew; their last observations go to ``final_obs``."""
        ended, last = self._ended.copy(), self._observed()
        final: NDArray[Any] = np.full(self.num_envs, None, dtype=object)
        for w in np.flatnonzero(ended).tolist():
            final[w] = {name: values[w] for name, values in last.items()}
        self._begin(ended, [self._drawn(w) for w in range(self.num_envs)])
        self._ended[:] = False
        ends = {"final_obs": final, "_final_obs": ended, "final_info": info, "_final_info": ended}
        return self._info() | ends

    def _begin(self, where: NDArray[np.bool_], seeds: Sequence[int]) -> None:
        worlds = np.flatnonzero(where).tolist()
        chosen = [seeds[w] for w in worlds]
        self._take(self._batch.reset(worlds=worlds, seeds=chosen, **self._options))

    def _take(self, obs: BatchObservation) -> None:
        """Keep the rows of an observation."""
        if obs.errors:
            raise error_of(obs.errors[0])
        rows = obs.worlds
        state = np.stack([obs.of_ego(name) for name in STATE], axis=1)
        self._seen["state"][rows] = np.clip(state, -FAR, FAR)
        self._seen["route"][rows] = np.clip(obs.route, -FAR, FAR)
        for name, values in obs.metrics.items():
            if name not in self._metrics:
                self._metrics[name] = np.full(self.num_envs, np.nan)
            self._metrics[name][rows] = values
        for name in self._metrics.keys() - obs.metrics.keys():
            self._metrics[name][rows] = np.nan

        for images in obs.images:
            name = images.sensor
            if images.modality != "rgb":
                name = f"{name}/{images.modality}"
            # A slower camera keeps its last images until the next ones are due.
            most, dtype = FORMS[images.modality]
            if name not in self._seen:
                self._seen[name] = np.zeros((self.num_envs, *images.shape), dtype)
            self._seen[name][images.worlds] = np.minimum(images.array, most)

    def _space(self) -> Any:
        parts: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(-FAR, FAR, (len(STATE),), np.float32),
            "route": spaces.Box(-FAR, FAR, (WAYPOINTS, 2), np.float32),
        }
        for name in self._seen.keys() - parts.keys():
            most, dtype = FORMS[name.partition("/")[2] or "rgb"]
            parts[name] = spaces.Box(0, most, self._seen[name].shape[1:], dtype)
        return spaces.Dict(parts)

    def _observed(self) -> Arrays:
        return {name: values.copy() for name, values in self._seen.items()}

    def _info(self) -> dict[str, Any]:
        everywhere = np.ones(self.num_envs, np.bool_)
        metrics: dict[str, Any] = {}
        for name, values in self._metrics.items():
            metrics |= {name: values.copy(), f"_{name}": everywhere}
        return {"metrics": metrics, "_metrics": everywhere}

    def _drawn(self, world: int) -> int:
        return int(self._random[world].integers(2**31))

    def _mask(self, options: dict[str, Any] | None) -> NDArray[np.bool_]:
        given = dict(options or {})
        where = np.asarray(given.pop("reset_mask", np.ones(self.num_envs, np.bool_)))
        if given or where.shape != (self.num_envs,) or where.dtype != np.bool_ or not where.any():
            raise ValueError(
                f"options of reset may hold reset_mask, [{self.num_envs}] bool with one world at "
                f"least; given were {options!r}"
            )
        return where

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        seeds: list[int | None] = (
            [seed + w for w in range(self.num_envs)] if isinstance(seed, int) else list(seed)
        )
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} worlds; give one for each")
        return seeds


def _commands(actions: ArrayLike, worlds: int) -> NDArray[np.float64]:
    """Acceleration [m/s^2] and road-wheel angle [rad], [N, 2]."""
    given = np.asarray(actions, dtype=np.float64)
    if given.shape != (worlds, 2):
        raise ValueError(f"actions must be [{worlds}, 2], not {list(given.shape)}")
    push, turn = np.clip(given, -1.0, 1.0).T
    return np.stack([push * np.where(push > 0, ACCELERATION, BRAKING), turn * STEERING], axis=1)


def _rewards(before: Arrays, now: Arrays) -> NDArray[np.float64]:
    """As of ``real2sim.DriveEnv``, for each world."""

    def gained(name: str) -> NDArray[np.float64]:
        gain: NDArray[np.float64] = np.nan_to_num(now[name]) - np.nan_to_num(before[name])
        return gain

    off_road = 1.0 - np.nan_to_num(now["on_road"], nan=1.0)
    reward = gained("route_progress") - 10.0 * gained("at_fault_collisions") - 0.1 * off_road
    return np.where(np.isfinite(reward), reward, 0.0)


gymnasium.register(id=VECTOR_ENV_ID, vector_entry_point="real2sim.vector_env:DriveVectorEnv")
