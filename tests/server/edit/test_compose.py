from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto.operations import Delete, Duplicate, Scale, Translate
from real2sim_server.edit import ScenarioState, apply_operations, instances_at
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


def test_objects_stand_where_their_trajectory_says(street):
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


def test_edits_show(street):
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

    assert [i.instance_id for i in instances] == [0, 1, 3, 5]
    assert instances[1].scale == (2, 1, 1)
    np.testing.assert_allclose(instances[1].T_world_object[:3, 3], [21, 5, 0.8])
    assert instances[3].cloud is street.objects["turning"].cloud


def test_a_state_of_another_scene_is_refused(street, tiny_scene):
    with pytest.raises(UnknownObjectError):
        instances_at(tiny_scene, ScenarioState.of(street), 0)
