"""The street that ships with the demo."""

import numpy as np
import pytest

from real2sim_server.demo.run import CAMERAS, SCENE, STEP_US
from real2sim_server.demo.street import DURATION_S, SHIPPED, unpack_street
from real2sim_server.reconstruct.evaluation import mean_psnr, psnr, render_logged_view
from real2sim_server.scene.io import load_scene, read_packed
from real2sim_server.synthetic import SyntheticConfig, generate_log
from real2sim_server.synthetic.traffic import plan_drive

COMPARED_FRAMES = (3, 37)


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


@pytest.fixture(scope="module")
def views_and_truth(street):
    """(rendered, true, sky) images of every camera in a few frames of the drive."""
    truth = generate_log(SyntheticConfig.from_values(street.provenance["config"]))
    views = []
    for frame in COMPARED_FRAMES:
        t_us = int(truth.frame_times_us[frame])
        for camera in street.rig:
            pose = camera.pose(truth.ego.transform(t_us))
            image, depth, _ = truth.render(pose, camera.K, camera.width, camera.height, t_us)
            views.append((render_logged_view(street, camera, t_us), image, depth == 0))
    return views


def test_it_looks_like_the_drive_of_its_provenance(views_and_truth):
    assert mean_psnr(psnr(view, image) for view, image, _ in views_and_truth) >= 30


def test_its_sky_is_that_of_its_provenance(views_and_truth):
    skies = [(view, image, sky) for view, image, sky in views_and_truth if np.mean(sky) > 0.02]
    assert len(skies) >= len(COMPARED_FRAMES)
    assert mean_psnr(psnr(*item) for item in skies) >= 28


def test_it_ships_with_the_true_ground_of_its_provenance(street):
    assert read_packed(SHIPPED).stored_ground is not None
    course = plan_drive(SyntheticConfig.from_values(street.provenance["config"])).street
    s, d = np.meshgrid(np.arange(0.0, 70.0, 0.5), np.arange(-5.25, 3.5, 0.25))
    heights = street.ground.height_at(course.point(s, d).reshape(-1, 2))
    assert np.sqrt((heights**2).mean()) < 0.01
    assert np.abs(heights).max() < 0.05
