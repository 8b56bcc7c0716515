from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_proto.base import Pose
from real2sim_proto.operations import Delete, Duplicate, EraseRegion, Scale, Translate
from real2sim_server.edit import ScenarioState, apply_operations, instances_at
from real2sim_server.edit.light import relit
from real2sim_server.scene import Scene, SceneObject
from real2sim_server.scene.errors import UnknownObjectError


@pytest.fixture
def street(summary, tiny_scene: Scene) -> Scene:
    """The objects of ``summary`` with the Gaussians of another scene's objects."""
    cloud = next(iter(tiny_scene.objects.values())).cloud
    objects = {
        o.object_id: SceneObject(o.object_id, o.category, o.size, cloud, o.trajectory)
        for o in summary.objects
    }
    return Scene(
        name="street",
        background=tiny_scene.background,
        objects=objects,
        sky=None,
        rig=tiny_scene.rig,
        ego=summary.ego,
        frame_times_us=summary.ego.times_us,
    )


def test_the_background_comes_first_and_is_not_copied(street):
    instances = instances_at(street, ScenarioState.of(street), 0)

    assert instances[0].cloud is street.background
    assert instances[0].T_world_object is None
    assert instances[0].instance_id == 0


def test_objects_are_placed_by_their_trajectories(street):
    state = ScenarioState.of(street)
    instances = instances_at(street, state, 2_150_000)

    assert [i.instance_id for i in instances] == [0, 1, 2, 3, 4]
    for instance, subject in zip(instances[1:], street.objects.values(), strict=True):
        expected = subject.trajectory.transform(2_150_000)
        np.testing.assert_allclose(instance.T_world_object, expected, atol=1e-12)
        assert instance.cloud is subject.cloud


def test_objects_outside_their_time_range_are_left_out(street):
    ids = [i.instance_id for i in instances_at(street, ScenarioState.of(street), 0)]

    assert ids == [0, 1, 2, 3]


def test_edits_are_visible(street):
    edited = apply_operations(
        ScenarioState.of(street),
        [
            Delete(object_id="crossing"),
            Translate(object_id="parked", x=1),
            Scale(object_id="parked", x=2),
            Duplicate(object_id="turning", new_id="twin"),
        ],
    ).state
    instances = instances_at(street, edited, 0)

    assert [i.instance_id for i in instances if i.instance_id] == [1, 3, 5]
    assert instances[1].scale == (2, 1, 1)
    np.testing.assert_allclose(instances[1].T_world_object[:3, 3], [21, 5, 0.8])
    assert instances[3].cloud is street.objects["turning"].cloud


def test_a_state_of_another_scene_is_refused(street, tiny_scene):
    with pytest.raises(UnknownObjectError):
        instances_at(tiny_scene, ScenarioState.of(street), 0)


def shadows(instances):
    return [i for i in instances[1:] if i.instance_id == 0]


def test_recorded_objects_do_not_cast_a_second_shadow(street):
    assert shadows(instances_at(street, ScenarioState.of(street), 0)) == []


def test_a_moved_object_casts_a_shadow_of_its_footprint(street):
    state = ScenarioState.of(street)
    moved = apply_operations(state, [Translate(object_id="parked", x=-6, y=-3)]).state
    (shadow,) = shadows(instances_at(street, moved, 0))

    places = shadow.cloud.means.numpy() + shadow.T_world_object[:3, 3]
    np.testing.assert_allclose(places.min(axis=0), [11.7, 0.7, 0.03], atol=0.25)
    np.testing.assert_allclose(places.max(axis=0), [16.3, 3.3, 0.03], atol=0.25)


def test_an_object_moved_back_has_no_added_shadow(street):
    there = Translate(object_id="parked", x=-6)
    back = Translate(object_id="parked", x=6)
    state = apply_operations(ScenarioState.of(street), [there, back]).state

    assert shadows(instances_at(street, state, 0)) == []


def test_a_shadow_fades_and_disappears_as_its_object_rises(street):
    def darkness(height: float) -> float:
        lift = Translate(object_id="parked", x=-6, z=height)
        state = apply_operations(ScenarioState.of(street), [lift]).state
        return sum(float(s.cloud.opacities.max()) for s in shadows(instances_at(street, state, 0)))

    assert darkness(0) > darkness(0.5) > darkness(2) == 0


def test_erased_regions_hide_their_gaussians_and_share_the_rest(street):
    inside = street.background.means[:, 0].double().numpy() < 15.0
    region = EraseRegion(pose=Pose(position=(5, 0, 0)), size=(20, 100, 100))
    state = apply_operations(ScenarioState.of(street), [region]).state
    shown = instances_at(street, state, 0)[0].cloud

    np.testing.assert_array_equal(shown.opacities.numpy() == 0, inside)
    assert shown.means is street.background.means
    assert instances_at(street, state, 100)[0].cloud is shown


def test_moved_objects_and_copies_keep_their_uncertainties(tiny_scene):
    red = tiny_scene.object("car_red")
    known = replace(red.cloud, uncertainties=torch.full((len(red.cloud),), 0.1))
    objects = dict(tiny_scene.objects) | {"car_red": replace(red, cloud=known)}
    scene = replace(tiny_scene, objects=objects)
    edits = [Translate(object_id="car_red", y=2.0), Duplicate(object_id="car_red", y=3.0)]
    state = apply_operations(ScenarioState.of(scene), edits).state
    shown = [i.cloud for i in instances_at(scene, state, scene.start_us)]
    assert sum(cloud is known for cloud in shown) == 2
    assert relit(known, (1.2, 0.9, 0.8)).uncertainties is known.uncertainties
