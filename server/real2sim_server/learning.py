"""Reinforcement learning without a socket: many worlds in one process, as a Gymnasium environment.

Importing this registers ``real2sim/DriveBatch-v0`` with Gymnasium. It needs the extra ``gym``.

::

    import gymnasium

    env = gymnasium.make_vec(
        "real2sim_server.learning:real2sim/DriveBatch-v0",
        num_envs=64,
        scene="street.r2s",
        cameras=["front"],
    )
    obs, info = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from real2sim_proto.episode import ResetSpec

from .demo.street import SHIPPED
from .render import (
    Backend,
    RasterOptions,
    RenderError,
    View,
    WorldViews,
    rasterize_batch,
    rasterize_worlds,
)
from .render.images import to_uint8
from .scene import Camera, Scene
from .scene.io import open_scene, read_packed
from .world.batch import BatchWorld
from .world.path import WAYPOINTS

# --- Images ---------------------------------------------------------------------------------------

RGB = RasterOptions(depth=False, instance=False, detail="auto")


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """A camera of another size with the centre of the view of ``camera``.

    The image is scaled until one side fits and cropped at the other, so that pixels stay square.
    """
    scale = max(width / camera.width, height / camera.height)
    K = camera.K.copy()
    K[:2] *= scale
    K[0, 2] -= (camera.width * scale - width) / 2
    K[1, 2] -= (camera.height * scale - height) / 2
    return replace(camera, width=width, height=height, K=K)


def batch_images(
    batch: BatchWorld,
    cameras: Sequence[Camera],
    worlds: Sequence[int],
    *,
    backend: str | Backend = "auto",
) -> NDArray[np.uint8]:
    """Images of cameras of one size in some worlds, [len(worlds), C, H, W, 3] uint8.

    Args:
        batch: the worlds.
        cameras: C cameras.
        worlds: indices of the worlds.
        backend: renderer.

    Raises:
        RenderError: cameras that are not pinholes; batches do not support lenses.
    """
    for camera in cameras:
        if not camera.is_pinhole:
            raise RenderError(
                f"camera {camera.name!r} has a lens or a rolling shutter; images of batches are "
                "those of pinholes"
            )
    width, height = cameras[0].width, cameras[0].height
    if not len(worlds):
        return np.zeros((0, len(cameras), height, width, 3), np.uint8)
    sky = batch.scene.sky
    shown = batch.shown(worlds)
    poses = np.stack([batch.body_pose(w) for w in worlds])
    viewmats = np.stack([camera.viewmat(poses) for camera in cameras], axis=1)
    if shown is None:
        views = [
            View(batch.instances(w), viewmat, camera.K)
            for w, each in zip(worlds, viewmats, strict=True)
            for viewmat, camera in zip(each, cameras, strict=True)
        ]
        drawn = rasterize_batch(views, width, height, sky=sky, options=RGB, backend=backend)
    else:
        Ks = np.stack([camera.K for camera in cameras])
        seen = WorldViews(shown.things, shown.poses, shown.there, shown.times_us, viewmats, Ks)
        drawn = rasterize_worlds(seen, width, height, sky=sky, options=RGB, backend=backend)
    return to_uint8(drawn.rgb).reshape(len(worlds), len(cameras), height, width, 3)


Arrays = dict[str, NDArray[Any]]

ACCELERATION, BRAKING, STEERING = 4.0, 8.0, 0.6
"""Values of actions of 1, -1 and, for steering, 1: [m/s^2], [m/s^2], [rad]; as in
``real2sim.DriveEnv``.
"""
FAULT, OFF_ROAD = 10.0, 0.1
"""Penalties [m] of an at-fault contact and of each step after leaving the road."""
FAR = 1e4
STATE_COLUMNS = (3, 7, 4, 5, 6)
"""Speed, lateral speed, acceleration, steering, yaw rate in a row of motions."""


class VectorDriveEnv(VectorEnv[Arrays, NDArray[np.float32], Arrays]):
    """N worlds of one scene that are stepped in one call.

    Actions, observations and rewards of each are those of the single environment
    ``real2sim.DriveEnv``: ``state`` [N, 5], ``route`` [N, 20, 2] float32 and [N, H, W, 3] uint8
    for each camera; images are drawn with ``detail="auto"``, all in one call. What the episodes may
    be is said in ``world.batch.subset``. Ends are reset as Gymnasium's ``autoreset_mode`` says.
    ``info`` has arrays of N: ``progress`` [m] and ``contacts`` of the step, ``route_s`` [m],
    ``off_road``.

    Args:
        num_envs: N.
        scene: a scene or the path of a bundle; the demo's street by default.
        cameras: names; none for no images.
        size: width and height of images [px]; a camera of another aspect is cut at its sides.
        options: fields of the reset: ``dt_us``, ``horizon``, ``agents`` and others.
        random_start: episodes begin up to so many seconds after the start of the log, drawn by
            the seed; 0 for always there.
        autoreset_mode: of Gymnasium: at the next step (its default), in the same step, or not.
        backend: draws images.

    Raises:
        WorldError: INVALID_REQUEST for options that batches do not know.
        SceneError: a camera that the scene does not have.
        ValueError: ``random_start`` that leaves no time to drive.

    Examples:
        >>> from real2sim_server.learning import VectorDriveEnv
        >>> env = VectorDriveEnv(num_envs=4, options={"horizon": 20})
        >>> obs, info = env.reset(seed=0)
        >>> obs["state"].shape, obs["route"].shape
        ((4, 5), (4, 20, 2))
        >>> obs, reward, terminated, truncated, info = env.step(np.tile([0.5, 0.0], (4, 1)))
        >>> bool((reward > 0).all()), terminated.tolist()
        (True, [False, False, False, False])
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scene: Scene | str | Path | None = None,
        cameras: Sequence[str] = (),
        size: tuple[int, int] = (84, 84),
        options: Mapping[str, Any] | None = None,
        random_start: float = 0.0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        backend: str | Backend = "auto",
    ) -> None:
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.num_envs = num_envs
        loaded = _scene(scene)
        spec = ResetSpec(**{**dict(options or {}), "action": "control"})
        self.worlds = BatchWorld(loaded, spec, num_envs)
        self._cameras = [fitted(loaded.rig[name], *size) for name in cameras]
        self._backend = backend
        self._latest_us = self._latest_start(random_start)
        self.single_action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.single_observation_space: Any = self._space(size)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._random = [seeding.np_random()[0] for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, np.bool_)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Arrays, dict[str, Any]]:
        """Start new episodes in all worlds, or in those of ``options["reset_mask"]`` [N] bool.

        Args:
            seed: of the first world, incremented for the others; or one per world. It determines
                the
                start times of the episodes.
            options: only ``reset_mask``.

        Raises:
            ValueError: a seed or a mask of another length, or other options.
        """
        where = self._mask(options)
        seeds = self._seeds(seed)
        for w in np.flatnonzero(where).tolist():
            if seeds[w] is not None:
                self._random[w] = seeding.np_random(seeds[w])[0]
        self._begin(where)
        self._ended[where] = False
        return self._seen(), self._info(np.zeros(self.num_envs), np.zeros(self.num_envs, np.int64))

    def step(  # type: ignore[override]
        self, actions: ArrayLike
    ) -> tuple[Arrays, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Drive one time step in every world.

        Args:
            actions: [N, 2] in [-1, 1]: acceleration (1 is 4 m/s^2, -1 brakes by 8 m/s^2) and
                road-wheel angle (1 is 0.6 rad to the left).
        """
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise ValueError(
                f"worlds {np.flatnonzero(self._ended).tolist()} have ended; reset them by "
                "options={'reset_mask': ...}, or choose another autoreset_mode"
            )
        done = self.worlds.step(_commands(actions, self.num_envs))
        worlds, again = self.worlds, self._ended
        terminated = worlds.terminated & ~again
        truncated = worlds.truncated & ~again
        reward = done.progress - FAULT * done.at_fault - OFF_ROAD * (worlds.off_road & ~again)
        self._ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and again.any():
            self._begin(again)
        info = self._info(done.progress, done.contacts)
        seen = self._seen()
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            seen, info = self._same_step(seen, info)
        return seen, reward, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing is held open."""

    def _same_step(self, seen: Arrays, info: dict[str, Any]) -> tuple[Arrays, dict[str, Any]]:
        """The first observations of new episodes; the last ones are in ``final_obs``."""
        ended = self._ended.copy()
        final: NDArray[Any] = np.full(self.num_envs, None, dtype=object)
        for w in np.flatnonzero(ended).tolist():
            final[w] = {name: values[w].copy() for name, values in seen.items()}
        self._begin(ended)
        fresh = self._seen(np.flatnonzero(ended))
        for name, values in fresh.items():
            seen[name][ended] = values
        last = {name: np.array(values) for name, values in info.items()}
        self._ended[:] = False
        return seen, info | {
            "final_obs": final,
            "_final_obs": ended,
            "final_info": last,
            "_final_info": ended,
        }

    def _begin(self, where: NDArray[np.bool_]) -> None:
        starts: list[int | None] = [None] * int(where.sum())
        if self._latest_us:
            dt_us, first = self.worlds.spec.dt_us, self._first_us
            for i, w in enumerate(np.flatnonzero(where).tolist()):
                starts[i] = first + dt_us * int(
                    self._random[w].integers(self._latest_us // dt_us + 1)
                )
        self.worlds.reset(where, start_us=starts)

    @property
    def _first_us(self) -> int:
        given = self.worlds.spec.start_us
        return self.worlds.scene.start_us if given is None else given

    def _latest_start(self, seconds: float) -> int:
        spec = self.worlds.spec
        latest_us = round(seconds * 1e6)
        steps = spec.horizon or 1
        left_us = self.worlds.scene.end_us - self._first_us - steps * spec.dt_us
        if not 0 <= latest_us <= left_us:
            raise ValueError(
                f"random_start {seconds} s leaves no {steps} steps of {spec.dt_us} us in the log; "
                f"allowed are 0 to {left_us * 1e-6:.1f} s"
            )
        return latest_us

    def _seen(self, which: NDArray[np.int64] | None = None) -> Arrays:
        chosen = np.arange(self.num_envs) if which is None else which
        state = self.worlds.motions[chosen][:, STATE_COLUMNS]
        seen: Arrays = {
            "state": np.clip(state, -FAR, FAR).astype(np.float32),
            "route": np.clip(self.worlds.routes()[chosen], -FAR, FAR),
        }
        if self._cameras:
            images = batch_images(
                self.worlds, self._cameras, chosen.tolist(), backend=self._backend
            )
            for c, camera in enumerate(self._cameras):
                seen[camera.name] = np.ascontiguousarray(images[:, c])
        return seen

    def _info(self, progress: NDArray[np.float64], contacts: NDArray[np.int64]) -> dict[str, Any]:
        worlds, everywhere = self.worlds, np.ones(self.num_envs, np.bool_)
        values = {
            "progress": progress,
            "contacts": contacts,
            "route_s": worlds.route_s.copy(),
            "off_road": worlds.off_road.copy(),
        }
        return values | {f"_{name}": everywhere for name in values}

    def _space(self, size: tuple[int, int]) -> spaces.Dict:
        width, height = size
        parts: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(-FAR, FAR, (5,), np.float32),
            "route": spaces.Box(-FAR, FAR, (WAYPOINTS, 2), np.float32),
        }
        for camera in self._cameras:
            parts[camera.name] = spaces.Box(0, 255, (height, width, 3), np.uint8)
        return spaces.Dict(parts)

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


def _scene(scene: Scene | str | Path | None) -> Scene:
    if isinstance(scene, Scene):
        return scene
    return read_packed(SHIPPED) if scene is None else open_scene(scene)


def _commands(actions: ArrayLike, worlds: int) -> NDArray[np.float64]:
    """Acceleration [m/s^2] and road-wheel angle [rad], [N, 2]."""
    given = np.asarray(actions, dtype=np.float64)
    if given.shape != (worlds, 2):
        raise ValueError(f"actions must be [{worlds}, 2], not {list(given.shape)}")
    push, turn = np.clip(given, -1.0, 1.0).T
    return np.stack([push * np.where(push > 0, ACCELERATION, BRAKING), turn * STEERING], axis=1)


ENVIRONMENT = "real2sim/DriveBatch-v0"

if ENVIRONMENT not in gymnasium.registry:
    gymnasium.register(id=ENVIRONMENT, vector_entry_point="real2sim_server.learning:VectorDriveEnv")
