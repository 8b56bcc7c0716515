"""The paper's experiments: who takes part, when things touch, and what is seen of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.edit.state import ScenarioState
from real2sim_server.physics import PhysicsError
from real2sim_server.simulation.experiments import set_up, views, walls
from real2sim_server.simulation.experiments.film import FilmView, draw, look_at
from real2sim_server.simulation.experiments.viewing import visibility_of
from real2sim_server.simulation.playback import Playback
from real2sim_server.simulation.rollout import simulate


@pytest.fixture
def experiment(tiny_scene):
    state = ScenarioState.of(tiny_scene)
    return lambda name, **asked: set_up(name, tiny_scene, state, **asked)


@pytest.fixture
def rollout(tiny_scene):
    """Simulates the beginning of an experiment."""

    def run(made, duration):
        options = replace(made.options, duration=duration, max_particles=5000)
        return simulate(tiny_scene, ScenarioState.of(tiny_scene), options)

    return run


def first_touch(result, *, other):
    return min(c.first_s for c in result.contacts if c.other == other)


def test_the_wall_is_met_after_half_a_metre(experiment, rollout):
    result = rollout(experiment("wall", objects=["car_red"]), 0.24)
    assert first_touch(result, other="wall") == pytest.approx(0.5 / 2.5, abs=0.02)


def test_runners_meet_those_they_run_into_after_a_metre_and_a_half(experiment, rollout):
    made = experiment("pair", objects=["car_red", "car_blue"])
    assert made.options.gravity == (0.0, 0.0, 0.0)
    result = rollout(made, 0.5)
    assert first_touch(result, other="car_blue") == pytest.approx(1.5 / 3.5, abs=0.04)


@pytest.mark.parametrize("preset", ["paper", "vehicle"])
def test_what_is_dropped_reaches_the_road_after_half_a_second(experiment, rollout, preset):
    made = experiment("drop", objects=["car_red"], preset=preset)
    result = rollout(made, 0.56)
    touches = [c.first_s for c in result.contacts if c.other in ("ground", "tyres")]
    assert min(touches) == pytest.approx(0.5, abs=0.06)


def test_unknown_experiments_and_objects_are_named(experiment):
    with pytest.raises(PhysicsError, match="allowed are wall, pair, drop"):
        experiment("jump")
    with pytest.raises(PhysicsError, match="nobody"):
        experiment("wall", objects=["nobody"])


def test_a_vehicle_that_drives_ahead_was_seen_from_behind(tiny_scene):
    state = ScenarioState.of(tiny_scene)
    blue = next(o for o in state.visible if o.object_id == "car_blue")
    seen = visibility_of(tiny_scene, blue)
    assert seen.rear > 10 * seen.front
    assert seen.direction[0] < 0
    assert seen.whole == seen.rear + seen.front


def test_a_wall_is_outlined_where_it_stands(experiment):
    made = experiment("wall", objects=["car_red"])
    wall = next(c for c in made.options.colliders if c.name == "wall")
    [corners] = walls(made)
    np.testing.assert_allclose((corners - wall.point) @ wall.normal, 0.0, atol=1e-9)
    assert walls(experiment("drop", objects=["car_red"])) == []


def test_what_takes_no_part_is_left_out_where_it_would_stand_before_the_camera(
    tiny_scene, experiment, rollout
):
    made = experiment("wall", objects=["car_red"])
    playback = Playback(tiny_scene, ScenarioState.of(tiny_scene), rollout(made, 0.01))
    near = views(playback, made)[1]
    post = np.array([10.0, 3.5, 1.0])
    eye = post + np.array([-2.0, 0.0, 0.0])
    looking = FilmView(replace(near.camera, T_vehicle_camera=look_at(eye, post)), near.background)
    seen_there, left_out = (
        draw(playback, [replace(looking, clear=clear)], 0, "cpu")[0] for clear in (0.0, 2.5)
    )
    green = [image[..., 1].astype(int) - image[..., 0] > 60 for image in (seen_there, left_out)]
    assert green[0].any()
    assert not green[1].any()
