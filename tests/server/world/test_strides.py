"""Walking animation of storyboard pedestrians by distance covered."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import Storyboard
from real2sim_server.edit import ScenarioState
from real2sim_server.scenarios.flat_scene import fitted_to_scene, flat_scene
from real2sim_server.scenarios.gallery import corner_case
from real2sim_server.world import World
from real2sim_server.world.sensing import ray_targets


@pytest.fixture(scope="module")
def crossing():
    """Worlds at each step while an adult crosses the road at 1.39 m/s."""
    fields = corner_case("cpna").storyboard().model_dump()
    speed = {"entity": "Ego", "action": {"kind": "speed", "speed": 10.0}}
    board = Storyboard.model_validate(fields | {"init": [*fields["init"], speed]})
    scene = flat_scene(board)
    board = fitted_to_scene(board, scene).model_copy(update={"drives_ego": True})
    spec = ResetSpec(
        storyboard=board, horizon=70, on_collision="continue", action="pose",
        contact={"dents": False},
    )  # fmt: skip
    worlds = [World(scene, ScenarioState.of(scene), spec)]
    while not worlds[-1].over:
        following = worlds[-1].fork()
        following.step()
        worlds.append(following)
    return worlds


def row_of(world) -> int:
    return [o.category for o in world.agents.objects].index("pedestrian")


def walker(world):
    return world.agents.objects[row_of(world)].object_id


def drawn(world) -> torch.Tensor:
    return world.instances()[1 + row_of(world)].cloud.means


def test_the_stride_phase_advances_with_distance(crossing):
    name = walker(crossing[0])
    steps = [w.strides.made[name].steps for w in crossing[1:]]
    speeds = [np.linalg.norm(w.agents.velocities[row_of(w)][:2]) for w in crossing[1:]]
    gone = np.array(speeds) > 1.3
    made = np.diff(steps)[gone[1:] & gone[:-1]]
    assert len(made) > 20
    # Steps of about 0.7 m at 1.39 m/s.
    np.testing.assert_allclose(made[8:], 0.139 / 0.67, rtol=0.15)


def test_legs_move_only_while_walking(crossing):
    speeds = np.array([np.linalg.norm(w.agents.velocities[row_of(w)][:2]) for w in crossing])
    waiting = next(k for k in range(1, len(speeds)) if speeds[k] == speeds[k + 1] == 0)
    walking = next(k for k in range(len(speeds)) if (speeds[k : k + 12] > 1.3).all()) + 10
    assert torch.equal(drawn(crossing[waiting]), drawn(crossing[waiting + 1]))
    moved = (drawn(crossing[walking]) - drawn(crossing[walking + 1])).norm(dim=1)
    assert float(moved.max()) > 0.1


def test_a_pedestrian_is_scaled_uniformly(crossing):
    world = crossing[0]
    subject = world.agents.objects[row_of(world)]
    assert subject.scaled_size == pytest.approx((0.5, 0.6, 1.8))
    assert len(set(subject.scale)) == 1


def test_lidars_and_cameras_use_the_same_cloud(crossing):
    world = crossing[-20]
    met = ray_targets(world).instances[1 + row_of(world)]
    assert torch.equal(met.cloud.means, drawn(world))


def test_forks_walk_identically(crossing):
    one, other = crossing[30].fork(), crossing[30].fork()
    for _ in range(5):
        one.step()
        other.step()
    assert torch.equal(drawn(one), drawn(other))
    assert torch.equal(drawn(one), drawn(crossing[35]))
