"""Several worlds as one Gymnasium vector environment."""

from __future__ import annotations

import doctest

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import Control
from real2sim_server import learning
from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState
from real2sim_server.learning import VectorDriveEnv, fitted
from real2sim_server.render import rasterize
from real2sim_server.render.images import to_uint8
from real2sim_server.render.rasterize import SMALL_IMAGES
from real2sim_server.scene import Scene
from real2sim_server.scene.io import read_packed
from real2sim_server.world import World
from real2sim_server.world.common import WorldError


@pytest.fixture(scope="module")
def street() -> Scene:
    return read_packed(SHIPPED)


def straight(worlds: int) -> np.ndarray:
    return np.tile([0.5, 0.0], (worlds, 1)).astype(np.float32)


def test_the_environment_is_made_by_its_id(street: Scene) -> None:
    env = gymnasium.make_vec(
        "real2sim_server.learning:real2sim/DriveBatch-v0",
        num_envs=3,
        scene=street,
        cameras=["front"],
        size=(20, 16),
    )
    obs, _ = env.reset(seed=1)
    assert env.observation_space.contains(obs)
    obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(obs)
    assert obs["front"].shape == (3, 16, 20, 3)
    assert reward.shape == terminated.shape == truncated.shape == (3,)
    env.close()


def test_images_and_rewards_equal_those_of_single_worlds(street: Scene) -> None:
    env = VectorDriveEnv(2, scene=street, cameras=["front"], options={"horizon": 5})
    env.reset(seed=0)
    world = World(street, ScenarioState.of(street), ResetSpec(action="control", horizon=5))
    before = world.metrics()
    world.step(Control(acceleration=2.0, steering=0.0))
    obs, reward, *_ = env.step(straight(2))
    now = world.metrics()
    assert reward[1] == pytest.approx(now["route_progress"] - before["route_progress"])
    camera = fitted(street.rig["front"], 84, 84)
    drawn = rasterize(
        world.instances(),
        camera.viewmat(world.T_world_body)[None],
        camera.K[None],
        84,
        84,
        sky=street.sky,
        options=SMALL_IMAGES,
    )
    assert np.array_equal(obs["front"][1], to_uint8(drawn.rgb)[0])


def test_ended_worlds_reset_at_the_next_step(street: Scene) -> None:
    env = VectorDriveEnv(2, scene=street, options={"horizon": 2})
    first, _ = env.reset(seed=0)
    env.step(straight(2))
    last, _, terminated, truncated, _ = env.step(straight(2))
    assert truncated.all()
    assert not terminated.any()
    assert last["state"][0, 0] > first["state"][0, 0]
    obs, reward, terminated, truncated, _ = env.step(straight(2))
    assert np.array_equal(obs["state"], first["state"])
    assert reward.tolist() == [0.0, 0.0]
    assert not (terminated | truncated).any()
    _, reward, *_ = env.step(straight(2))
    assert (reward > 0).all()


def test_ended_worlds_reset_in_the_same_step(street: Scene) -> None:
    env = VectorDriveEnv(
        2, scene=street, options={"horizon": 1}, autoreset_mode=AutoresetMode.SAME_STEP
    )
    first, _ = env.reset(seed=0)
    obs, reward, _, truncated, info = env.step(straight(2))
    assert truncated.all()
    assert (reward > 0).all()
    assert np.array_equal(obs["state"], first["state"])
    assert info["_final_obs"].all()
    assert info["final_obs"][1]["state"][0] > first["state"][1, 0]


def test_without_autoreset_ended_worlds_need_a_reset_mask(street: Scene) -> None:
    env = VectorDriveEnv(
        2, scene=street, options={"horizon": 1}, autoreset_mode=AutoresetMode.DISABLED
    )
    first, _ = env.reset(seed=0)
    env.step(straight(2))
    with pytest.raises(ValueError, match="have ended"):
        env.step(straight(2))
    obs, _ = env.reset(options={"reset_mask": np.array([True, True])})
    assert np.array_equal(obs["state"], first["state"])
    env.step(straight(2))


def test_seeds_determine_random_start_times(street: Scene) -> None:
    def begun(seed: int) -> list[int]:
        env = VectorDriveEnv(4, scene=street, options={"horizon": 5}, random_start=3.0)
        env.reset(seed=seed)
        return [int(t) for t in env.worlds.times_us]

    assert begun(3) == begun(3)
    assert begun(3) != begun(4)
    assert len(set(begun(3))) > 1
    assert begun(3)[1:] == begun(4)[:-1]


def test_a_camera_with_another_aspect_ratio_is_cropped_at_the_sides(street: Scene) -> None:
    front = street.rig["front"]
    camera = fitted(front, 84, 84)
    scale = 84 / front.height
    assert camera.K[0, 0] == pytest.approx(front.K[0, 0] * scale)
    assert camera.K[1, 1] == pytest.approx(front.K[1, 1] * scale)
    assert camera.K[0, 2] - 42 == pytest.approx((front.K[0, 2] - front.width / 2) * scale)


@pytest.mark.parametrize(
    ("arguments", "error", "named"),
    [
        ({"options": {"on_collision": "continue"}}, WorldError, "on_collision"),
        ({"random_start": 1e3}, ValueError, "random_start"),
        ({"num_envs": 0}, ValueError, "at least one"),
    ],
)
def test_unsupported_arguments_are_refused(
    street: Scene, arguments: dict, error: type[Exception], named: str
) -> None:
    with pytest.raises(error, match=named):
        VectorDriveEnv(**({"num_envs": 2, "scene": street} | arguments))


def test_invalid_actions_seeds_and_masks_are_refused(street: Scene) -> None:
    env = VectorDriveEnv(2, scene=street)
    with pytest.raises(ValueError, match="actions must be"):
        env.step(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="seeds for 2 worlds"):
        env.reset(seed=[1])
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([False, False])})


def test_the_docstring_example_runs() -> None:
    assert doctest.testmod(learning).failed == 0


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_kept_observations_do_not_change(street: Scene, mode: AutoresetMode) -> None:
    env = VectorDriveEnv(
        2,
        scene=street,
        cameras=["front"],
        size=(16, 16),
        options={"horizon": 3},
        autoreset_mode=mode,
    )
    kept = [env.reset(seed=0)[0]]
    before = [{name: array.copy() for name, array in kept[0].items()}]
    for _ in range(3):
        kept.append(env.step(straight(2))[0])
        before.append({name: array.copy() for name, array in kept[-1].items()})
    env.reset(seed=1)
    for now, then in zip(kept, before, strict=True):
        for name, array in now.items():
            np.testing.assert_array_equal(array, then[name], err_msg=name)
