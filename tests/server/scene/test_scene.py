from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.scene import Asset, SceneError, TimeOutOfRangeError, UnknownObjectError


def test_objects_are_found_by_id_and_numbered_from_one_in_order(scene):
    assert scene.object("car_3").object_id == "car_3"
    assert [scene.instance_id(k) for k in scene.objects] == [1, 2, 3]


@pytest.mark.parametrize("method", ["object", "instance_id"])
def test_an_unknown_object_is_refused_with_the_known_ones(scene, method):
    with pytest.raises(UnknownObjectError, match=r"no object 'car_9' in scene 'street'.*car_7"):
        getattr(scene, method)("car_9")


def test_counts_and_bytes_add_up(scene):
    clouds = [scene.background, *(o.cloud for o in scene.objects.values())]
    assert scene.gaussian_count == sum(len(c) for c in clouds) == 100 + 20 + 21 + 22
    assert scene.nbytes == sum(c.nbytes for c in clouds) + 6 * 4 * 4 * 3 * 4


def test_the_time_range_is_that_of_the_ego(scene):
    assert (scene.start_us, scene.end_us) == (7, 400_007)


def test_objects_and_provenance_cannot_be_changed(scene):
    with pytest.raises(TypeError):
        scene.objects["car_7"] = None
    with pytest.raises(TypeError):
        scene.provenance["source"] = "other"


def test_moving_to_the_same_device_shares_the_tensors(scene):
    again = scene.to("cpu")
    assert again.background.means.data_ptr() == scene.background.means.data_ptr()
    assert again.object("car_7").cloud is scene.object("car_7").cloud


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"frame_times_us": np.array([2, 1])}, "increase strictly"),
        ({"frame_times_us": np.array([[1, 2]])}, "one-dimensional"),
        ({"ego_size": (4.0, 0.0, 1.0)}, "ego of scene 'street'"),
    ],
)
def test_bad_scenes_are_refused(scene, change, reason):
    with pytest.raises(SceneError, match=reason):
        replace(scene, **change)


def test_an_object_under_another_key_is_refused(scene):
    with pytest.raises(SceneError, match="'car_7' is stored under 'x'"):
        replace(scene, objects={"x": scene.object("car_7")})


@pytest.mark.parametrize("size", [(4, 2), (4, 2, 0), (4, 2, -1), (4, 2, float("nan"))])
def test_sizes_that_are_not_three_positive_lengths_are_refused(scene, size):
    with pytest.raises(SceneError, match="three positive lengths"):
        replace(scene.object("car_7"), size=size)
    with pytest.raises(SceneError, match="asset 'a'"):
        Asset("a", "car", size, scene.object("car_7").cloud)


def test_the_box_of_an_object_follows_its_trajectory(scene):
    car = scene.object("car_7")
    box = car.box_at(100_007)
    np.testing.assert_allclose(box.mean(axis=0), car.trajectory.pose(100_007)[0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(box[1] - box[0]), 4.5)
    with pytest.raises(TimeOutOfRangeError):
        car.box_at(0)
