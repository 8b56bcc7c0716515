from __future__ import annotations

from dataclasses import replace

import numpy as np

from real2sim_server.geometry import transform_from
from real2sim_server.reconstruct.evaluation.report import depth_image, error_image, object_crops
from real2sim_server.reconstruct.logged_view import moving_tracks, tracks_mask

from ..conftest import painted_log

FRAME = 4


def test_error_images_are_brighter_for_larger_errors():
    truth = np.full((4, 6, 3), 100, np.uint8)
    image = truth.copy()
    image[:, 2:4] += 20
    image[:, 4:] += 60
    brightness = error_image(image, truth).sum(axis=(0, 2))
    assert error_image(truth, truth).max() < 10
    assert brightness[0] < brightness[2] < brightness[4]


def test_depth_images_run_from_red_to_blue_with_black_holes():
    image = depth_image(np.array([[3.0, 60.0, 0.0]], np.float32))[0].astype(int)
    assert image[0, 0] > image[0, 2]
    assert image[1, 2] > image[1, 0]
    assert (image[2] == 0).all()


def test_a_crop_shows_the_box_of_a_moving_object():
    log = painted_log()
    camera = log.rig["front"]
    [(object_id, window)] = object_crops(log, camera, FRAME, 3)
    t_us = int(log.frame_times_us[FRAME])
    pose = log.ego.transform(t_us) @ camera.T_vehicle_camera
    mask = tracks_mask(moving_tracks(log), camera, pose, t_us)
    assert object_id == "other_1"
    assert mask[window].sum() == mask.sum() > 0
    assert mask[window].mean() > 0.5


def test_an_occluded_object_is_not_cropped():
    log = painted_log()
    track = log.tracks[0]
    path = track.trajectory
    away = transform_from([3.0, 0, 0], [1.0, 0, 0, 0])
    behind = replace(track, object_id="other_2", trajectory=path.moved(away))
    both = replace(log, tracks=(behind, track))
    assert [name for name, _ in object_crops(both, log.rig["front"], FRAME, 3)] == ["other_1"]
