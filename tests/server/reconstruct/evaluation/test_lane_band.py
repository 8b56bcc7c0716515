from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.logs import ObjectTrack
from real2sim_server.reconstruct import InitialiseOptions, initialise_scene
from real2sim_server.reconstruct.evaluation.shifted import (
    evaluate_lane_band,
    projected_road,
    road_colours,
)
from real2sim_server.scene import Ground, Trajectory

from ..conftest import ROAD_COLOUR, painted_log

SMALL = InitialiseOptions(max_background=10_000, voxel=0.2, ground_spacing=0.2, sky_resolution=16)


@pytest.fixture(scope="module")
def log():
    return painted_log(frames=3, boxes=False)


def test_road_points_have_the_road_colour_and_lie_on_the_ground(log):
    road = road_colours(log, log.rig["front"], Ground.level(0.0))
    assert len(road.points) > 500
    np.testing.assert_allclose(road.points[:, 2], 0, atol=1e-6)
    np.testing.assert_allclose(road.colours, np.broadcast_to(ROAD_COLOUR, road.colours.shape))


def test_a_lateral_camera_offset_shifts_road_points(log):
    camera = log.rig["front"]
    road = road_colours(log, camera, Ground.level(0.0))
    one = replace(road, points=np.array([[8.0, 0, 0]]), colours=road.colours[:1])
    columns = [projected_road(one, log, camera, 0, left)[0][0] % camera.width for left in (0, 1)]
    assert columns[1] - columns[0] == pytest.approx(camera.K[0, 0] / 8.0, abs=1)


def test_road_points_inside_boxes_are_ignored():
    log = painted_log(frames=5)
    camera = log.rig["front"]
    road = road_colours(log, camera, Ground.level(0.0))
    centre = log.tracks[0].trajectory.transform(200_000)[:3, 3]
    inside = replace(road, points=centre[None], colours=road.colours[:1])
    assert len(projected_road(inside, log, camera, 200_000, 0.0)[0]) == 0


def test_the_score_drops_for_a_wrong_road_colour(log):
    scene = initialise_scene(log, options=SMALL)
    [good] = evaluate_lane_band(scene, log, log.rig["front"], [1], [1.0])
    dark = replace(
        scene,
        background=replace(scene.background, sh=scene.background.sh - 1),
        content_hash="",
    )
    [bad] = evaluate_lane_band(dark, log, log.rig["front"], [1], [1.0])
    assert good.views == 2
    assert good.psnr > 25 > 15 > bad.psnr
    assert good.images_psnr == bad.images_psnr > 40


def test_views_close_to_a_box_are_skipped(log):
    scene = initialise_scene(log, options=SMALL)
    times = log.frame_times_us
    pose = np.eye(4)
    pose[:3, 3] = (-3.0, 2.2, 1.0)
    beside = Trajectory.from_transforms(times, np.broadcast_to(pose, (len(times), 4, 4)))
    parked = replace(log, tracks=(ObjectTrack("1", "car", (7.0, 2.0, 2.0), beside),))
    [score] = evaluate_lane_band(scene, parked, log.rig["front"], [1], [1.0])
    assert score.views == 1
