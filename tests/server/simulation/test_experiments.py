"""The paper's experiments: who takes part, when things touch, and what the camera sees."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from real2sim_proto.operations import Duplicate
from real2sim_server.edit import apply_operations
from real2sim_server.edit.state import ScenarioState
from real2sim_server.geometry import box_penetration
from real2sim_server.physics import PhysicsError
from real2sim_server.simulation.experiments import FilmPlan, set_up, views
from real2sim_server.simulation.experiments.film import FilmView, draw, look_at, obstacle_cloud
from real2sim_server.simulation.experiments.setups import visibility_of
from real2sim_server.simulation.result import Playback
from real2sim_server.simulation.rollout import simulate

PARTICLES = 5000
"""Of all objects together: far fewer than experiments have."""


@pytest.fixture
def experiment(tiny_scene):
    state = ScenarioState.of(tiny_scene)
    return lambda name, **asked: set_up(name, tiny_scene, state, **asked)


@pytest.fixture
def rollout(tiny_scene):
    """Simulates the beginning of an experiment."""

    def run(made, duration):
        options = replace(made.options, duration=duration, max_particles=PARTICLES)
        return simulate(tiny_scene, ScenarioState.of(tiny_scene), options)

    return run


def first_touch(result, *, other):
    return min(c.first_s for c in result.contacts if c.other == other)


def test_the_wall_is_reached_after_half_a_metre(experiment, rollout):
    result = rollout(experiment("wall", objects=["car_red"]), 0.24)
    assert first_touch(result, other="wall") == pytest.approx(0.5 / 2.5, abs=0.02)


def test_moving_vehicles_reach_the_others_after_one_and_a_half_metres(
    experiment, rollout, tiny_scene
):
    made = experiment("pair", objects=["car_red", "car_blue"])
    assert made.options.gravity == (0.0, 0.0, 0.0)
    result = rollout(made, 0.5)
    # Distance is measured between the experiment's own particles. These are farther apart: half a
    # cell of the grid, and each surface may lie up to half of that elsewhere.
    volumes = [np.prod(tiny_scene.objects[o].size) for o in ("car_red", "car_blue")]
    spacing = float(np.cbrt(sum(volumes) / PARTICLES))
    assert first_touch(result, other="car_blue") == pytest.approx(1.5 / 3.5, abs=spacing / 3.5)


@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_any_number_of_pairs_collide_and_none_starts_overlapping(tiny_scene, count):
    copies = [Duplicate(object_id="car_red", new_id=f"copy_{k}", x=5.0 * k) for k in range(7)]
    state = apply_operations(ScenarioState.of(tiny_scene), copies).state
    names = ("car_red", "car_blue", *(f"copy_{k}" for k in range(7)))[:count]
    made = set_up("pair", tiny_scene, state, objects=names)
    speeds = {n: np.linalg.norm(o.velocity) for n, o in made.options.objects.items()}
    assert sorted(speeds) == sorted(names)
    assert [speeds[n] > 0 for n in names] == [True] * (count // 2) + [False] * (count - count // 2)
    there = {o.object_id: o for o in state.visible}
    boxes = [(o.T_world_object, there[n].scaled_size) for n, o in made.options.objects.items()]
    for k, box in enumerate(boxes):
        assert all(box_penetration(*box, *other) < 0.05 for other in boxes[:k])


@pytest.mark.parametrize("preset", ["paper", "vehicle"])
def test_a_dropped_object_reaches_the_road_after_half_a_second(experiment, rollout, preset):
    made = experiment("drop", objects=["car_red"], preset=preset)
    result = rollout(made, 0.56)
    touches = [c.first_s for c in result.contacts if c.other in ("ground", "tyres")]
    assert min(touches) == pytest.approx(0.5, abs=0.06)


def test_unknown_experiments_and_objects_are_reported_by_name(experiment):
    with pytest.raises(PhysicsError, match="allowed are wall, pair, drop"):
        experiment("jump")
    with pytest.raises(PhysicsError, match="nobody"):
        experiment("wall", objects=["nobody"])


def test_a_vehicle_driving_ahead_was_seen_from_behind(tiny_scene):
    state = ScenarioState.of(tiny_scene)
    blue = next(o for o in state.visible if o.object_id == "car_blue")
    seen = visibility_of(tiny_scene, blue)
    assert seen.rear > 10 * seen.front
    assert seen.direction[0] < 0
    assert seen.whole == seen.rear + seen.front


def test_a_wall_is_drawn_behind_its_surface(experiment, tiny_scene):
    made = experiment("wall", objects=["car_red"])
    wall = next(c for c in made.options.colliders if c.name == "wall")
    [obstacle] = FilmPlan.of(made, tiny_scene.ground.height).obstacles
    beyond = (obstacle_cloud(obstacle).means.numpy() - wall.point) @ wall.normal
    assert beyond.max() == pytest.approx(0.0, abs=1e-3)
    assert beyond.min() < -0.2
    dropped = experiment("drop", objects=["car_red"])
    assert FilmPlan.of(dropped, tiny_scene.ground.height).obstacles == ()


def test_crashes_start_just_before_the_obstacle_and_on_the_road(experiment):
    for name, other in (("frontal", "barrier"), ("pole", "pole")):
        made = experiment(name, objects=["car_red"])
        pose = made.options.objects["car_red"].T_world_object
        box = next(c for c in made.options.colliders if c.name == other)
        away = (box.T_world_box[:3, 3] - pose[:3, 3]) @ pose[:3, 0]
        assert away - box.size[0] / 2 - 2.0 == pytest.approx(1.2, abs=0.01)
        assert made.options.preset == "vehicle"
    turned = experiment("roof", objects=["car_red"]).options.objects["car_red"]
    assert turned.T_world_object[2, 2] < -0.8


@pytest.mark.slow
@pytest.mark.parametrize(("name", "other"), [("frontal", "barrier"), ("pole", "pole")])
def test_a_car_is_driven_into_an_object_on_the_road(experiment, rollout, name, other):
    result = rollout(experiment(name, objects=["car_red"]), 0.15)
    assert 0.04 < first_touch(result, other=other) < 0.12


@pytest.mark.slow
def test_a_t_bone_hits_a_side_and_a_roof_crash_hits_the_road(experiment, rollout):
    result = rollout(experiment("t_bone", objects=["car_red", "car_blue"]), 0.15)
    assert 0.03 < first_touch(result, other="car_blue") < 0.12
    turned = experiment("roof", objects=["car_red"])
    assert 0.03 < first_touch(rollout(turned, 0.12), other="ground") < 0.1


def test_camera_settings_are_kept(experiment, tiny_scene, tmp_path):
    plan = FilmPlan.of(experiment("frontal", objects=["car_red"]), tiny_scene.ground.height)
    plan.save(tmp_path)
    kept = FilmPlan.load(tmp_path)
    assert kept.slow == plan.slow == 4
    assert kept.without == plan.without
    np.testing.assert_array_equal(kept.obstacles[0][0], plan.obstacles[0][0])
    with pytest.raises(PhysicsError, match=r"film\.json"):
        FilmPlan.load(tmp_path / "nowhere")


def test_a_t_bone_is_filmed_together_with_the_struck_vehicle(experiment, tiny_scene, tmp_path):
    made = experiment("t_bone", objects=["car_red", "car_blue"])
    FilmPlan.of(made, tiny_scene.ground.height).save(tmp_path)
    plan = FilmPlan.load(tmp_path)
    assert plan.follows == "car_blue"
    places = np.array([[10.0, 0.0, 0.5], [10.0, 0.0, 0.6], [14.0, 1.0, 0.5]])
    result = SimpleNamespace(objects={"car_blue": SimpleNamespace(positions=places)})
    playback = SimpleNamespace(scene=tiny_scene, result=result)
    recorded, near = views(playback, plan)
    went = [near.camera_at(k).T_vehicle_camera - near.camera.T_vehicle_camera for k in range(3)]
    np.testing.assert_allclose([w[:3, 3] for w in went], [[0, 0, 0], [0, 0, 0], [4, 1, 0]])
    assert not np.any(went[2][:3, :3])
    assert recorded.camera_at(2) is recorded.camera
    kept = json.loads((tmp_path / "film.json").read_text())
    del kept["follows"]
    (tmp_path / "film.json").write_text(json.dumps(kept))
    assert views(playback, FilmPlan.load(tmp_path))[1].moved is None


def test_a_roof_crash_is_filmed_from_the_side_that_lands_first(experiment):
    made = experiment("roof", objects=["car_red"])
    pose = made.options.objects["car_red"].T_world_object
    lower = pose[:3, 1] * -np.sign(pose[2, 1])
    assert lower @ made.side > 0.3


def test_bystanders_blocking_the_camera_are_left_out(tiny_scene, experiment, rollout):
    made = experiment("wall", objects=["car_red"])
    playback = Playback(tiny_scene, ScenarioState.of(tiny_scene), rollout(made, 0.01))
    near = views(playback, FilmPlan.of(made, tiny_scene.ground.height))[1]
    post = np.array([10.0, 3.5, 1.0])
    eye = post + np.array([-2.0, 0.0, 0.0])
    looking = FilmView(replace(near.camera, T_vehicle_camera=look_at(eye, post)), near.background)
    seen_there, left_out = (
        draw(playback, [replace(looking, clear=clear)], 0, "cpu")[0] for clear in (0.0, 2.5)
    )
    green = [image[..., 1].astype(int) - image[..., 0] > 60 for image in (seen_there, left_out)]
    assert green[0].any()
    assert not green[1].any()
