"""The street that ships with the demo."""

import pytest

from real2sim_server.demo.run import CAMERAS, SCENE, STEP_US
from real2sim_server.demo.street import DURATION_S, SHIPPED, unpack_street
from real2sim_server.scene.io import load_scene


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    scenes = tmp_path_factory.mktemp("scenes")
    unpack_street(scenes, SCENE)
    return load_scene(scenes / SCENE)


def test_it_is_small_enough_to_ship():
    assert SHIPPED.stat().st_size <= 12e6


def test_it_lasts_a_hundred_steps_and_has_the_cameras_of_the_demo(street):
    assert street.end_us - street.start_us >= 100 * STEP_US
    assert street.end_us - street.start_us <= (DURATION_S + 1) * 1e6
    assert set(CAMERAS) <= set(street.rig.names)


def test_it_was_trained_and_says_how_well(street):
    made = street.provenance["reconstruction"]
    assert made["iterations"] > 0
    assert made["held_out_frames"]


def test_cars_in_it_are_objects(street):
    assert sum(item.category in ("car", "van", "truck") for item in street.objects.values()) >= 8
