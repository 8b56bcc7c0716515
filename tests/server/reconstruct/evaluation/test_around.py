"""Views from all sides of vehicles against ground truth."""

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.geometry import invert_transform
from real2sim_server.reconstruct import InitialiseOptions, initialise_scene
from real2sim_server.reconstruct.evaluation.images import (
    HEIGHT,
    WIDTH,
    evaluate_around,
    logged_azimuths,
    view_from,
)
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log


@pytest.fixture(scope="module")
def street():
    config = SyntheticConfig(
        seed=5,
        frames=6,
        width=96,
        height=64,
        cameras=(CameraSpec("front"),),
        samples=1,
        moving_cars=1,
        parked_cars=1,
        lidar_columns=512,
    )
    return generate_log(config)


@pytest.mark.parametrize("azimuth", [0.0, np.pi / 2, np.pi, -1.0])
def test_a_view_is_centred_on_its_object_from_the_azimuth(street, azimuth):
    track = street.tracks[0]
    t_us = track.trajectory.start_us
    camera, T_world_camera = view_from(track, t_us, azimuth)
    pose = track.trajectory.transform(t_us)
    u, v, depth = camera.K @ (invert_transform(T_world_camera) @ pose)[:3, 3]
    x, y, _ = (invert_transform(pose) @ T_world_camera)[:3, 3]
    assert (u / depth, v / depth) == pytest.approx((WIDTH / 2, HEIGHT / 2))
    assert np.cos(np.arctan2(y, x) - azimuth) == pytest.approx(1)
    assert T_world_camera[2, 1] < 0


def test_a_car_ahead_is_seen_from_behind(street):
    azimuths = logged_azimuths(street, street.tracks[0])
    assert azimuths
    assert np.cos(np.array(azimuths) - np.pi).min() > 0.8


@pytest.mark.slow
def test_a_missing_vehicle_half_lowers_coverage(street):
    options = InitialiseOptions(
        max_background=8_000, max_object=3_000, voxel=0.3, ground_spacing=0.5, sky_resolution=16
    )
    scene = initialise_scene(street, options=options)
    name = street.tracks[0].object_id
    only = replace(scene, objects={name: scene.objects[name]})
    whole = evaluate_around(only, street, min_views=2)
    item = only.objects[name]
    half = replace(item, cloud=item.cloud.select(item.cloud.means[:, 0] > 0))
    cut = evaluate_around(replace(only, objects={name: half}), street, min_views=2)
    assert {side.object_id for side in whole.sides} == {name}
    assert 0 < sum(side.seen for side in whole.sides) < len(whole.sides)
    assert whole.coverage_unseen > 0.9
    assert cut.coverage_unseen < whole.coverage_unseen - 0.2
    assert cut.psnr_unseen < whole.psnr_unseen
