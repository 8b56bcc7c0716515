"""The Gymnasium environment against a real worker."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import real2sim

gymnasium = pytest.importorskip("gymnasium")
pytestmark = pytest.mark.network


@pytest.fixture
def env(site):
    made = real2sim.make_env(url=site.url, scene="tiny", sensors=["front"], render_mode="rgb_array")
    yield made
    made.close()


def test_check_env_passes(env):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)


def test_the_reset_seed_determines_the_randomization(env):
    ranges = {"randomization": {"start": {"lateral": 0.5, "speed": 2.0}}}
    seen, infos = zip(*(env.reset(seed=s, options=ranges) for s in (1, 1, 2)), strict=True)
    assert set(infos[0]["drawn"]) == {"start.lateral", "start.speed"}
    assert infos[0]["drawn"] == infos[1]["drawn"] != infos[2]["drawn"]
    assert seen[0]["state"][0] == seen[1]["state"][0] != seen[2]["state"][0]
    unseeded = [env.reset(options=ranges)[1]["drawn"] for _ in range(2)]
    assert unseeded[0] != unseeded[1]


def test_seeds_have_no_effect_without_randomization(env):
    (first, info), (other, _) = env.reset(seed=1), env.reset(seed=2)
    assert info["drawn"] == {}
    assert all((first[k] == other[k]).all() for k in first)


def test_lidars_and_radars_are_arrays_of_points(site):
    made = real2sim.make_env(
        url=site.url, scene="tiny", lidars=["vlp-16"], radars=["corner"], points=64
    )
    try:
        assert made.observation_space["vlp-16"].shape == (64, 4)
        obs, _ = made.reset(seed=0)
        assert made.observation_space.contains(obs)
        assert obs["vlp-16"].any()
        assert obs["corner"].shape == (256, 5)
        # Evenly spaced returns, not the first ones.
        sweep = made.last.lidar("vlp-16")
        assert sweep.count > 64
        np.testing.assert_array_equal(
            obs["vlp-16"][:, :3], sweep.points[np.arange(64) * sweep.count // 64]
        )
        assert "agents" not in obs
    finally:
        made.close()


def test_changing_an_observation_does_not_affect_the_next(site):
    slow = {"camera": "front", "period_us": 300_000}
    made = real2sim.make_env(url=site.url, scene="tiny", sensors=[slow], render_mode="rgb_array")
    try:
        obs, _ = made.reset(seed=0)
        first = obs["front"].copy()
        obs["front"][:] = 0
        made.render()[:] = 0
        later = made.step(np.zeros(2, np.float32))[0]["front"]
        assert later is not obs["front"]
        np.testing.assert_array_equal(later, first)
    finally:
        made.close()


def test_kept_observations_do_not_change(site):
    slow = {"camera": "front", "period_us": 300_000, "modalities": ["rgb", "depth"]}
    made = real2sim.make_env(
        url=site.url,
        scene="tiny",
        sensors=[slow, "left"],
        lidars=["vlp-16"],
        radars=["corner"],
        points=64,
        agents=4,
    )
    try:
        kept = [made.reset(seed=0)[0]]
        before = [{name: array.copy() for name, array in kept[0].items()}]
        nothing = np.zeros(2, np.float32)
        for take in (*[lambda: made.step(nothing)[0]] * 4, lambda: made.reset(seed=1)[0]):
            kept.append(take())
            before.append({name: array.copy() for name, array in kept[-1].items()})
        for now, then in zip(kept, before, strict=True):
            assert set(now) == set(made.observation_space.spaces)
            for name, array in now.items():
                assert array.flags.writeable
                np.testing.assert_array_equal(array, then[name], err_msg=name)
        arrays = [array for obs in kept for array in obs.values()]
        pairs = ((a, b) for k, a in enumerate(arrays) for b in arrays[:k])
        assert not any(np.shares_memory(a, b) for a, b in pairs)
    finally:
        made.close()


def test_an_episode_with_random_actions_ends(env):
    env.action_space.seed(0)
    obs, _ = env.reset(seed=1)
    assert env.observation_space.contains(obs)
    over, steps = False, 0
    while not over:
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        over, steps = terminated or truncated, steps + 1
        assert np.isfinite(reward)
        assert env.observation_space.contains(obs)
    assert steps <= 20
    assert "pdms" in info["metrics"]
    assert env.render().shape == (64, 96, 3)


def test_the_reward_is_the_distance_driven(env):
    env.reset(seed=1)
    _, reward, *_ = env.step(np.zeros(2, np.float32))
    assert reward == pytest.approx(0.5, abs=0.01)


@pytest.fixture
def made(site):
    """Create environments on the tiny scene that are closed after the test."""
    opened = []

    def make(**options):
        opened.append(real2sim.make_env(url=site.url, scene="tiny", **options))
        return opened[-1]

    yield make
    for env in opened:
        env.close()


def test_depth_and_instance_images_have_their_own_keys(made):
    sensor = {"camera": "front", "modalities": ["rgb", "depth", "instance"], "width": 48}
    env = made(sensors=[sensor, {"camera": "left", "modalities": ["depth"]}])
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    images = {name: (obs[name].shape, obs[name].dtype.name) for name in obs if "/" in name}
    assert images == {
        "front/depth": ((32, 48), "float32"),
        "front/instance": ((32, 48), "uint16"),
        "left/depth": ((64, 96), "float32"),
    }
    assert obs["front"].shape == (32, 48, 3)
    assert "left" not in obs
    assert obs["front/depth"].max() > 5.0


def test_without_cameras_the_nearest_agents_are_observed(made, tiny_scene):
    env = made()
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert obs["agents"].shape == (16, 9)
    seen = obs["agents"][obs["agents"][:, 0] == 1]
    assert len(seen) == 3
    blue, *_ = seen
    velocity = tiny_scene.objects["car_blue"].trajectory
    speed = (velocity.positions[-1] - velocity.positions[0])[0] / 2.0
    assert blue == pytest.approx([1, 8, 0, 1, 0, speed, 0, 4.2, 1.8], abs=1e-3)
    assert not obs["agents"][3:].any()


def test_agents_are_in_the_vehicle_frame(made):
    env = made(agents=2, options={"ego": {"max_steer": 0.6}})
    env.reset(seed=0)
    for _ in range(10):
        obs, *_ = env.step(np.array([0.0, 1.0], np.float32))
    yaw = env.last.ego.yaw
    assert yaw > 0.1
    x, y = obs["agents"][0, 1:3]
    back = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ (x, y)
    positions = [agent.position[:2] for agent in env.last.agents]
    offsets = np.array(positions) - env.last.ego.position[:2]
    assert np.linalg.norm(offsets - back, axis=1).min() < 1e-4
    assert np.linalg.norm((x, y)) == pytest.approx(np.linalg.norm(offsets, axis=1).min(), abs=1e-4)


def test_agents_are_added_to_cameras_only_on_request(made):
    assert "agents" not in made(sensors=["front"]).observation_space.spaces
    assert made(sensors=["front"], agents=4).observation_space["agents"].shape == (4, 9)


def test_the_registered_environment_passes_check_env(site):
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make("real2sim.env:real2sim/Drive-v0", url=site.url, scene="tiny")
    assert env.spec.id == "real2sim/Drive-v0"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_a_gymnasium_vector_environment_steps_several_sessions(site):
    options = {"num_envs": 2, "url": site.url, "scene": "tiny", "vectorization_mode": "sync"}
    env = gymnasium.make_vec("real2sim.env:real2sim/Drive-v0", **options)
    env.reset(seed=0)
    seen, reward, *_ = env.step(np.array([[1.0, 0.0], [-1.0, 0.0]], np.float32))
    speed = seen["state"][:, 0]
    assert speed[0] > speed[1]
    assert reward[0] > reward[1]
    env.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"agents": -1}, "agents is -1"),
        (
            {
                "render_mode": "rgb_array",
                "sensors": [{"camera": "front", "modalities": ["depth"]}],
            },
            "no sensor shows rgb",
        ),
    ],
)
def test_an_invalid_environment_is_refused_and_leaves_no_session(site, made, options, said):
    with pytest.raises(ValueError, match=said):
        made(**options)
    assert len(site.worker.sessions) == 0


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_stable_baselines3_ppo_trains_for_2000_steps(env):
    sb3 = pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3")
    from stable_baselines3.common.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
        agent = sb3.PPO("MultiInputPolicy", env, n_steps=500, batch_size=100, n_epochs=2, seed=0)
        before = {k: v.clone() for k, v in agent.policy.state_dict().items()}
        agent.learn(2000)
    assert agent.num_timesteps == 2000
    after = agent.policy.state_dict()
    assert all(bool(v.isfinite().all()) for v in after.values())
    assert any(bool((after[k] != v).any()) for k, v in before.items())
    assert len(agent.ep_info_buffer) >= 50
