"""Invalid setups are refused with the reason before simulation starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.edit.state import ScenarioState
from real2sim_server.physics import PhysicsError, Plane
from real2sim_server.physics.validation.check import placed as at
from real2sim_server.simulation.rollout import SimulateOptions, simulate
from real2sim_server.simulation.spawn import object_particles, spaced_for, spawn_bodies
from real2sim_server.simulation.structure import ObjectPhysics, preset_of
from real2sim_server.simulation.tyres import track_of

GROUND = Plane(name="ground", friction=0.7)


@pytest.fixture
def rollout(tiny_scene):
    """Simulates a short part of a scene, by default the tiny one with its red car."""

    def run(objects=None, *, scene=tiny_scene, **changes):
        objects = {"car_red": ObjectPhysics()} if objects is None else objects
        options = {"objects": objects, "colliders": [GROUND], "duration": 0.02, "frame_rate": 100.0}
        return simulate(scene, ScenarioState.of(scene), SimulateOptions(**options | changes))

    return run


@pytest.mark.parametrize(
    ("physics", "message"),
    [
        ({"velocity": (1e6, 0, 0)}, "velocity of 'car_red' .* at most 200 m/s"),
        ({"velocity": (np.nan, 0, 0)}, "velocity of 'car_red' must be 3 finite numbers"),
        ({"angular_velocity": (0, 0, 1e4)}, "at most 100 rad/s"),
        ({"angular_velocity": (0, 1)}, "must be 3 finite numbers"),
        ({"T_world_object": np.diag([2.0, 1, 1, 1])}, "must be rigid"),
    ],
)
def test_invalid_settings_of_an_object_are_refused_by_name(rollout, physics, message):
    with pytest.raises(PhysicsError, match=message):
        rollout({"car_red": ObjectPhysics(**physics)})


@pytest.mark.parametrize(
    ("physics", "message"),
    [
        ({"mass": 0.0}, "mass of an object must be positive"),
        ({"friction": -1.0}, "friction of an object must not be negative"),
        ({"restitution": 1.5}, r"restitution of an object must be in \[0, 1\]"),
        ({"brake": np.nan}, r"brake of an object must be in \[0, 1\]"),
    ],
)
def test_out_of_range_numbers_are_refused_immediately(physics, message):
    with pytest.raises(PhysicsError, match=message):
        ObjectPhysics(**physics)


def test_objects_that_start_overlapping_are_named(rollout):
    here = {"T_world_object": at(8.0, 0.0, 0.75)}
    with pytest.raises(PhysicsError, match=r"'car_red' and 'car_blue' are .* inside each other"):
        rollout({"car_red": ObjectPhysics(**here), "car_blue": ObjectPhysics()})


def test_objects_whose_boxes_just_touch_are_simulated(rollout):
    beside = ObjectPhysics(T_world_object=at(8.0, 1.75, 0.75), velocity=(0, 0, 0))
    result = rollout({"car_red": beside, "car_blue": ObjectPhysics(velocity=(0, 0, 0))})
    assert result.stopped == "done"


def test_an_object_that_starts_inside_a_wall_is_named(rollout):
    wall = Plane(name="wall", point=(14.0, 0, 0), normal=(-1, 0, 0))
    with pytest.raises(PhysicsError, match=r"'car_red' is .* inside collider 'wall'"):
        rollout(colliders=[GROUND, wall])


def test_duplicate_names_are_refused(rollout):
    with pytest.raises(PhysicsError, match=r"must be unique; \['ground'\]"):
        rollout(colliders=[GROUND, GROUND])


def test_bodies_share_the_particle_budget(rollout):
    whole, fewer = rollout(), rollout(max_particles=800)
    assert fewer.figures["particles"] <= 800 < whole.figures["particles"]
    assert fewer.figures["cell"] > whole.figures["cell"]
    assert fewer.objects["car_red"].mass == pytest.approx(whole.objects["car_red"].mass)


def test_too_few_particles_to_deform_are_refused(rollout):
    with pytest.raises(PhysicsError, match=r"too coarse for 'car_red'.*raise max_particles"):
        rollout(max_particles=100)


def test_an_object_of_ten_million_particles_is_filled_more_coarsely(rollout, tiny_scene):
    scene = tiny_scene
    huge = replace(scene.objects["car_red"], size=(40.0, 18.0, 15.0))
    scene = replace(scene, objects=dict(scene.objects) | {"car_red": huge})
    result = rollout(scene=scene, duration=0.01, preset="paper", colliders=[], max_particles=20_000)
    assert result.figures["particles"] <= 20_000


def test_mass_from_density_does_not_depend_on_the_particles(rollout):
    masses = [
        rollout(preset="paper", colliders=[], max_particles=most).objects["car_red"].mass
        for most in (100_000, 4_000, 1_000)
    ]
    assert masses == pytest.approx([masses[0]] * 3)


@pytest.mark.parametrize(("category", "stability"), [("car", 1.41), ("van", 1.12)])
def test_vehicles_centre_of_mass_height_matches_published_values(tiny_scene, category, stability):
    red = next(o for o in ScenarioState.of(tiny_scene).visible if o.object_id == "car_red")
    subject = replace(red, category=category)
    particles = object_particles(tiny_scene, subject, preset_of("vehicle"), 0)
    above_road = particles.centre_of_mass[2] + subject.scaled_size[2] / 2
    assert track_of(subject.scaled_size) / 2 / above_road == pytest.approx(stability, rel=1e-3)
    assert particles.masses.min() > 0


def test_a_vehicles_structure_does_not_move_its_centre_of_mass(tiny_scene):
    state, preset = ScenarioState.of(tiny_scene), preset_of("vehicle")
    red = next(o for o in state.visible if o.object_id == "car_red")
    (body,) = spawn_bodies(
        tiny_scene,
        state,
        {"car_red": ObjectPhysics()},
        preset=preset,
        start_us=0,
        colliders=[],
        road=[],
        gravity=np.zeros(3),
        max_particles=400_000,
    )
    height = object_particles(tiny_scene, red, preset, 0).centre_of_mass[2]
    assert body.rest.centre_of_mass[2] == pytest.approx(height, abs=1e-3)


def test_only_vehicles_have_coarser_particles(tiny_scene):
    preset = preset_of("vehicle")
    red = next(o for o in ScenarioState.of(tiny_scene).visible if o.object_id == "car_red")
    cone = replace(red, category="cone")
    assert spaced_for(preset, [red, red]).spacing == preset.vehicle_spacing > preset.spacing
    assert spaced_for(preset, [red, cone]).spacing == preset.spacing
    assert spaced_for(preset_of("paper"), [red]).spacing == preset_of("paper").spacing
