"""Episodes run the storyboard of their scenario."""

from __future__ import annotations

import pytest

from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import SetStoryboard
from real2sim_proto.storyboard import Storyboard
from real2sim_server.edit import EditError, ScenarioState, apply_operations
from real2sim_server.edit.state import pack_state, unpack_state
from real2sim_server.world import World

from .boards import action_at, board


@pytest.fixture
def world(make_world, moving):
    return make_world(moving(0, 0, speed=10.0), look=moving(500, 50))


@pytest.fixture
def written(world) -> ScenarioState:
    fields = board(action_at(0.5, {"kind": "speed", "speed": 3.0}))
    operation = SetStoryboard(storyboard=Storyboard.model_validate(fields))
    return apply_operations(world.state, [operation]).state


def test_a_scenario_s_storyboard_runs(world, written):
    episode = World(world.scene, written, ResetSpec(horizon=20))
    for _ in range(10):
        episode.step()
    assert episode.storyboard.entities["car"].speed == 3.0


def test_a_reset_may_bring_its_own_or_none(world, written):
    own = ResetSpec(horizon=5, storyboard=board(car={"category": "van"}))
    assert World(world.scene, written, own).storyboard.entities["car"].category == "van"
    none = World(world.scene, written, ResetSpec(horizon=5, storyboard={}))
    assert not none.storyboard.entities


def test_it_survives_a_snapshot(world, written):
    again = unpack_state(ScenarioState.of(world.scene), pack_state(written))
    assert again.storyboard == written.storyboard


def test_it_is_not_set_while_an_episode_runs(world):
    with pytest.raises(EditError, match="from its start"):
        world.apply([SetStoryboard()])
