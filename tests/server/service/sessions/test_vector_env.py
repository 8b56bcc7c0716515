"""The vector environment of the SDK: many sessions, one message a step."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

import real2sim
from real2sim.vector_env import DriveVectorEnv

pytestmark = pytest.mark.network

ACTIONS = np.array([[1.0, 0.1], [0.3, -0.2], [-0.5, 0.0]], np.float32)


@pytest.fixture
def make(site) -> Iterator[Callable[..., DriveVectorEnv]]:
    made: list[DriveVectorEnv] = []

    def vector_env(count: int = 3, **options) -> DriveVectorEnv:
        made.append(DriveVectorEnv(count, url=site.url, scene="tiny", **options))
        return made[-1]

    yield vector_env
    for env in made:
        env.close()


def test_each_world_is_a_single_environment(make, site):
    env = make(options={"horizon": 6})
    seen, info = env.reset(seed=0)
    assert env.observation_space.contains(seen)
    single = real2sim.make_env(url=site.url, scene="tiny", agents=0, options={"horizon": 6})
    for world in range(len(ACTIONS)):
        alone, _ = single.reset(seed=0)
        assert data_equivalence({k: v[world] for k, v in seen.items()}, alone, exact=True)
    for step in range(6):
        seen, reward, terminated, truncated, info = env.step(ACTIONS)
        if step == 0:
            first = seen, reward
    for world, action in enumerate(ACTIONS):
        single.reset(seed=0)
        for step in range(6):
            alone, gained, ended, cut, told = single.step(action)
            if step == 0:
                assert gained == first[1][world]
        assert data_equivalence({k: v[world] for k, v in seen.items()}, alone, exact=True)
        assert (gained, ended, cut) == (reward[world], terminated[world], truncated[world])
        metrics = {k: v[world] for k, v in info["metrics"].items() if k[0] != "_"}
        assert {k: v for k, v in metrics.items() if not np.isnan(v)} == told["metrics"]
    single.close()


def test_each_world_has_the_images_of_a_single_environment(make, site):
    sensors = [{"camera": "front", "modalities": ["rgb", "depth"], "codec": "raw"}]
    env = make(2, sensors=sensors)
    seen, _ = env.reset(seed=0)
    assert env.observation_space.contains(seen)
    assert seen["front"].shape == (2, 64, 96, 3)
    single = real2sim.make_env(url=site.url, scene="tiny", sensors=sensors)
    single.reset(seed=0)
    seen, *_ = env.step(ACTIONS[:2])
    alone, *_ = single.step(ACTIONS[1])
    assert data_equivalence({k: v[1] for k, v in seen.items()}, alone, exact=True)
    single.close()


def test_ended_worlds_begin_anew_at_the_next_step(make):
    env = make(2, options={"horizon": 2})
    env.reset(seed=1)
    env.step(ACTIONS[:2])
    *_, truncated, _ = env.step(ACTIONS[:2])
    assert truncated.tolist() == [True, True]
    _, reward, _, truncated, info = env.step(ACTIONS[:2])
    assert (reward.tolist(), truncated.tolist()) == ([0.0, 0.0], [False, False])
    assert info["metrics"]["distance"].tolist() == [0.0, 0.0]


def test_ended_worlds_begin_anew_in_the_same_step(make):
    env = make(2, options={"horizon": 2}, autoreset_mode=AutoresetMode.SAME_STEP)
    begun, _ = env.reset(seed=1)
    env.step(ACTIONS[:2])
    seen, reward, _, truncated, info = env.step(ACTIONS[:2])
    assert truncated.tolist() == [True, True]
    assert (reward > 0).all()
    assert info["_final_obs"].tolist() == [True, True]
    assert info["final_obs"][0]["state"][0] != seen["state"][0][0]
    assert seen["state"].tobytes() == begun["state"].tobytes()


def test_what_is_not_allowed_is_said(make):
    env = make(2, options={"horizon": 1}, autoreset_mode="Disabled")
    env.reset()
    with pytest.raises(ValueError, match=r"actions must be \[2, 2\]"):
        env.step(ACTIONS)
    env.step(ACTIONS[:2])
    with pytest.raises(ValueError, match=r"worlds \[0, 1\] have ended"):
        env.step(ACTIONS[:2])
    env.reset(options={"reset_mask": np.array([False, True])})
    with pytest.raises(ValueError, match=r"worlds \[0\] have ended"):
        env.step(ACTIONS[:2])
    with pytest.raises(real2sim.Real2SimError, match="deadline_ms"):
        make(1, options={"deadline_ms": 20})


def test_a_batch_goes_on_after_its_connection_was_lost(site):
    with (
        real2sim.connect(site.url) as client,
        client.batch(scene="tiny", worlds=2) as batch,
    ):
        batch.reset(action="control")
        plans = {"kind": "control", "values": [[1.0, 0.0], [0.5, 0.0]]}
        batch.step(plans)
        batch._socket.socket.shutdown(2)
        obs = batch.step(plans)
        assert obs.step.tolist() == [2, 2]
        assert obs.errors == []
