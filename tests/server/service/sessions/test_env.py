"""The Gymnasium environment, and the example of the README, against a worker as it is."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import real2sim

gymnasium = pytest.importorskip("gymnasium")
pytestmark = pytest.mark.network

README = Path(__file__).resolve().parents[4] / "README.md"


@pytest.fixture
def env(site):
    made = real2sim.make_env(url=site.url, scene="tiny", sensors=["front"], render_mode="rgb_array")
    yield made
    made.close()


def test_check_env_passes(env):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(unwrapped|render modes|infinity).*")
        check_env(env, skip_render_check=True)


def test_the_seed_of_reset_draws_what_is_randomized(env):
    ranges = {"randomization": {"start": {"lateral": 0.5, "speed": 2.0}}}
    seen, infos = zip(*(env.reset(seed=s, options=ranges) for s in (1, 1, 2)), strict=True)
    assert set(infos[0]["drawn"]) == {"start.lateral", "start.speed"}
    assert infos[0]["drawn"] == infos[1]["drawn"] != infos[2]["drawn"]
    assert seen[0]["state"][0] == seen[1]["state"][0] != seen[2]["state"][0]
    unseeded = [env.reset(options=ranges)[1]["drawn"] for _ in range(2)]
    assert unseeded[0] != unseeded[1]


def test_seeds_change_nothing_where_nothing_is_randomized(env):
    (first, info), (other, _) = env.reset(seed=1), env.reset(seed=2)
    assert info["drawn"] == {}
    assert all((first[k] == other[k]).all() for k in first)


def test_an_episode_by_random_actions_ends(env):
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


def test_the_way_made_is_the_reward(env):
    env.reset(seed=1)
    _, reward, *_ = env.step(np.zeros(2, np.float32))
    assert reward == pytest.approx(0.5, abs=0.01)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_ppo_of_stable_baselines3_runs_2000_steps_without_changes(env):
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


def test_the_planner_example_of_the_readme_is_short_and_works(site, monkeypatch, capsys):
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)
    (example,) = (b for b in blocks if "session.step(" in b)
    assert len([line for line in example.splitlines() if line.strip()]) <= 15
    connect = real2sim.connect
    monkeypatch.setattr(real2sim, "connect", lambda *_a, **_k: connect(site.url))
    exec(example.replace('"street"', '"tiny"'), {})
    assert "pdms" in capsys.readouterr().out
